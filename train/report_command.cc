#include <cstdio>
#include <filesystem>
#include <string>
#include <system_error>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "train/commands.h"
#include "train/common_flags.h"
#include "train/report/report_page.h"
#include "train/report/report_runs.h"
#include "train/train_flags.h"

ABSL_FLAG(
    bool, smoke, false,
    "report: tiny models, coarse experts and few iterations, to see in minutes that all of it "
    "works");
ABSL_FLAG(std::vector<std::string>, environments, spikeserve::ReportOptions{}.environments,
          "report: the tasks, comma-separated");
ABSL_FLAG(int, seeds, spikeserve::ReportOptions{}.seeds, "report: seeds of training for each row");

namespace spikeserve {
namespace {

absl::StatusOr<ReportOptions> OptionsFromFlags() {
  const absl::StatusOr<std::string> out = RequiredOut("the directory to write into");
  if (!out.ok()) return out.status();
  const absl::StatusOr<TrainOptions> training = TrainOptionsFromFlags();
  if (!training.ok()) return training.status();
  absl::StatusOr<RecordOptions> data = RecordOptionsFromFlags();
  if (!data.ok()) return data.status();
  ReportOptions options;
  options.directory = *out;
  options.training = *training;
  options.data = *std::move(data);
  options.data.expert.tables_directory = *out;
  if (auto status = SetShapeFromFlags(&options.config); !status.ok()) return status;
  options.environments = absl::GetFlag(FLAGS_environments);
  options.seeds = absl::GetFlag(FLAGS_seeds);
  if (options.seeds < 1 || options.environments.empty()) {
    return absl::InvalidArgumentError(
        absl::StrCat("seeds, environments: expected at least one of each, received ", options.seeds,
                     " and ", options.environments.size()));
  }
  if (absl::GetFlag(FLAGS_smoke)) {
    options.data.steps = 400;
    options.data.expert.coarsening = 8;
    options.training.iterations = 20;
    options.training.batch = 4;
    options.episodes = 3;
    options.config.hidden_size = 16;
    options.config.heads = 2;
    options.config.ticks = 4;
    options.config.context = 4;
    options.config.ffn_size = 32;
    options.ticks = {2};
    options.contexts = {2};
  }
  return options;
}

}  // namespace

absl::Status ReportCommand(const std::string& command_line) {
  const absl::StatusOr<ReportOptions> options = OptionsFromFlags();
  if (!options.ok()) return options.status();
  const auto log = [](const std::string& name) {
    std::fprintf(stderr, "spiketrain: training %s\n", name.c_str());
  };
  const auto modes = RunAll(*options, ModeRuns(*options), log);
  if (!modes.ok()) return modes.status();
  const auto sweeps = RunAll(*options, SweepRuns(*options), log);
  if (!sweeps.ok()) return sweeps.status();
  const Report report = WriteReport(*options, command_line, *modes, *sweeps);
  absl::Status status = WriteFileAtomically(options->directory + "/report.md", {report.markdown});
  status.Update(
      WriteFileAtomically(options->directory + "/figures.json", {report.figures.dump(1), "\n"}));
  if (!status.ok()) return status;
  std::printf("%s/report.md\n%s/figures.json\nDraw the figures with: %s\n",
              options->directory.c_str(), options->directory.c_str(),
              PlotCommand(options->directory).c_str());
  return absl::OkStatus();
}

}  // namespace spikeserve
