#include "train/record_flags.h"

#include <filesystem>
#include <memory>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/model/policy_file.h"
#include "train/evaluation/training_record.h"

namespace spikeserve {

void AddExpertFlags(FlagGroup& group, ExpertOptions* options) {
  group.Add("expert", "NAME", &options->name, "Expert; default: the first one of --env")
      .Add("beam_width", "N", &options->beam_width, "Partial plans that --expert=beam keeps");
}

void AddTablesFlag(FlagGroup& group, ExpertOptions* options) {
  group.Add("tables", "DIR", &options->tables_directory,
            "Directory of the experts' value tables; default: that of --out");
}

void AddRecordFlags(FlagGroup& group, RecordFlags* flags) {
  RecordOptions& options = flags->options;
  group.Add("steps", "N", &options.steps, "Steps to record, at least")
      .Add("expert_fraction", "SHARE", &options.expert_fraction, "Share of the expert's steps")
      .Add("disturbed_fraction", "SHARE", &options.disturbed_fraction,
           "Share of steps in which bursts disturb the expert")
      .Add("student", "FILE", &flags->student,
           "Policy that plays the remaining steps; default: random")
      .AddSwitch("weigh", &options.weigh, "Weight labels by the loss of the worst action")
      .Add("burst_rate", "P", &options.burst_rate, "Largest probability that a burst begins")
      .Add("longest_burst", "N", &options.longest_burst, "Most steps of a burst")
      .Add("wide_start_fraction", "SHARE", &options.wide_start_fraction,
           "Share of disturbed episodes with any start (Pendulum)");
  AddExpertFlags(group, &options.expert);
}

absl::StatusOr<RecordOptions> ReadRecordOptions(const RecordFlags& flags) {
  RecordOptions options = flags.options;
  if (flags.student.empty()) return options;
  ASSIGN_OR_RETURN(Policy policy, ReadPolicyFile(flags.student));
  options.student = std::make_shared<const Policy>(std::move(policy));
  return options;
}

absl::StatusOr<Dataset> RecordFromFlags(const RecordFlags& flags, const std::string& out) {
  ASSIGN_OR_RETURN(RecordOptions options, ReadRecordOptions(flags));
  if (options.expert.tables_directory.empty()) {
    const std::filesystem::path path = out;
    options.expert.tables_directory = path.has_parent_path() ? path.parent_path().string() : ".";
  }
  if (absl::Status status = options.Validate(); !status.ok()) return NameFlag(status);
  absl::StatusOr<Dataset> dataset = RecordDataset(options);
  if (!dataset.ok() || flags.student.empty()) return dataset;
  ASSIGN_OR_RETURN(const std::string student, FileSha256(flags.student));
  dataset->recipe["student_sha256"] = student;
  return dataset;
}

absl::Status RequireOut(const std::string& out, absl::string_view what) {
  if (!out.empty()) return absl::OkStatus();
  return InvalidArgument("--out", what, "none");
}

absl::Status MakeOutDirectory(const std::string& path) {
  std::error_code error;
  std::filesystem::create_directories(path, error);
  if (!error) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("--out: cannot make the directory ", path, ": ", error.message()));
}

absl::Status MakeDirectoryOf(const std::string& out) {
  const std::filesystem::path directory = std::filesystem::path(out).parent_path();
  return directory.empty() ? absl::OkStatus() : MakeOutDirectory(directory.string());
}

absl::Status NameFlag(const absl::Status& status) {
  return absl::Status(status.code(), absl::StrCat("--", status.message()));
}

}  // namespace spikeserve
