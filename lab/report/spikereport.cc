// spikereport: repeats the experiments of the paper that are not finished in --out, and writes
// their figures there as JSON, for plot.py.
#include <cstdio>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/status_macros.h"
#include "lab/report/figure_data.h"
#include "lab/report/report_runs.h"
#include "train/record_flags.h"
#include "train/train_flags.h"
#include "train/trainer/memory.h"

namespace spikeserve {
namespace {

struct ReportFlags {
  std::string out;
  bool smoke = false;
  std::vector<std::string> environments = ReportOptions().environments;
  int seeds = ReportOptions().seeds;
  ShapeFlags shape;
  TrainerFlags trainer;
  RecordFlags record;
};

absl::StatusOr<ReportOptions> MakeOptions(const ReportFlags& flags) {
  if (auto status = RequireOut(flags.out, "the directory to write into"); !status.ok()) {
    return status;
  }
  ASSIGN_OR_RETURN(const TrainOptions training, MakeTrainOptions(flags.trainer));
  ASSIGN_OR_RETURN(RecordOptions data, ReadRecordOptions(flags.record));
  ReportOptions options;
  options.directory = flags.out;
  options.training = training;
  options.data = std::move(data);
  options.data.expert.tables_directory = flags.out;
  RETURN_IF_ERROR(SetShape(flags.shape, &options.config));
  options.environments = flags.environments;
  options.seeds = flags.seeds;
  if (options.seeds < 1 || options.environments.empty()) {
    return absl::InvalidArgumentError(
        absl::StrCat("--seeds, --environments: expected at least one of each, received ",
                     options.seeds, " and ", options.environments.size()));
  }
  if (flags.smoke) {
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

absl::Status MakeReport(const ReportFlags& flags, const std::string& command_line) {
  ASSIGN_OR_RETURN(const ReportOptions options, MakeOptions(flags));
  const auto log = [](const std::string& name) {
    std::fprintf(stderr, "spikereport: training %s\n", name.c_str());
  };
  ASSIGN_OR_RETURN(const auto modes, RunAll(options, ModeRuns(options), log));
  RETURN_IF_ERROR(RunAll(options, SweepRuns(options), log).status());
  const std::string plot = "python lab/report/plot.py " + options.directory;
  const auto pages = PageData(options, {command_line, plot});
  const auto figures = FigureData(options, GroupRuns(modes));
  absl::Status status = WriteFileAtomically(options.directory + "/runs.json", {pages.dump(), "\n"});
  status.Update(WriteFileAtomically(options.directory + "/figures.json", {figures.dump(), "\n"}));
  if (!status.ok()) return status;
  std::printf("%s/runs.json\n%s/figures.json\nWrite the page and draw its figures with: %s\n",
              options.directory.c_str(), options.directory.c_str(), plot.c_str());
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  spikeserve::KeepFreedMemory();
  spikeserve::Program program("spikereport", "Repeats the experiments of the paper");
  spikeserve::ReportFlags flags;
  const spikeserve::Command command = program.root();
  command.Flags("Report")
      .Add("out", "DIR", &flags.out, "Directory of the report and its runs")
      .AddSwitch("smoke", &flags.smoke, "Tiny models and few iterations: a test in minutes")
      .AddList("environments", "ID,...", &flags.environments, "Tasks")
      .Add("seeds", "N", &flags.seeds, "Training seeds of each row");
  spikeserve::FlagGroup shape = command.Flags("Shape");
  spikeserve::AddShapeFlags(shape, &flags.shape);
  spikeserve::AddTrainerFlags(command, &flags.trainer);
  spikeserve::FlagGroup recording = command.Flags("Recording");
  spikeserve::AddRecordFlags(recording, &flags.record);
  command.SetAction([&] { return spikeserve::MakeReport(flags, program.CommandLine()); });
  return program.Run(argc, argv);
}
