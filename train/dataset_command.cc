#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/action/step_source.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/dataset/recordings.h"
#include "train/commands.h"
#include "train/data/minari_writer.h"
#include "train/evaluation/training_record.h"
#include "train/record_flags.h"

namespace spikeserve {
namespace {

constexpr double kLargestLossWeight = 1e6;
constexpr char kRecording[] = "Recording, without --recordings";

struct DatasetFlags {
  std::string out;
  std::string recordings;          // recordings of a server to convert; empty: record new episodes
  std::optional<std::string> env;  // absent: all environments of the recordings, or CartPole-v1
  // Loss weights of the steps that operators and the policy chose; absent: all steps have 1.
  std::optional<double> correction_weight;
  std::optional<double> policy_weight;  // beside the other one; absent: 1
  RecordFlags record;
  bool json = false;
};

// Sets the loss weights of recorded steps by who chose their actions. What a safety layer, a
// fall-back or a hold chose is not to be imitated. Returns the number of the operators' steps.
int64_t WeighBySource(double correction_weight, double policy_weight, Dataset* dataset) {
  int64_t corrected = 0;
  for (Episode& episode : dataset->episodes) {
    episode.weights.assign(episode.actions.size(), 0.0f);
    for (int step = 0; step < episode.steps(); ++step) {
      const SourceKind kind = episode.source(step).kind;
      const bool by_policy = kind == SourceKind::kPolicy || kind == SourceKind::kLocal;
      if (by_policy) episode.weights[step] = static_cast<float>(policy_weight);
      if (kind != SourceKind::kOperator) continue;
      episode.weights[step] = static_cast<float>(correction_weight);
      ++corrected;
    }
  }
  return corrected;
}

absl::Status CheckWeight(const char* flag, double weight) {
  if (weight >= 0.0 && weight <= kLargestLossWeight) return absl::OkStatus();
  return InvalidArgument(flag, absl::StrCat("0 to ", kLargestLossWeight), weight);
}

absl::Status WeighCorrections(const DatasetFlags& flags, Dataset* dataset) {
  if (!flags.correction_weight.has_value()) return absl::OkStatus();
  RETURN_IF_ERROR(CheckWeight("--correction_weight", *flags.correction_weight));
  const double policy_weight = flags.policy_weight.value_or(1.0);
  RETURN_IF_ERROR(CheckWeight("--policy_weight", policy_weight));
  const int64_t corrected = WeighBySource(*flags.correction_weight, policy_weight, dataset);
  if (corrected == 0) {
    return InvalidArgument("--correction_weight", "recordings in which an operator acted", "none");
  }
  dataset->recipe["corrected_steps"] = corrected;
  dataset->recipe["correction_weight"] = *flags.correction_weight;
  dataset->recipe["policy_weight"] = policy_weight;
  return absl::OkStatus();
}

absl::StatusOr<Dataset> FromRecordings(const DatasetFlags& flags) {
  const std::string& path = flags.recordings;
  auto recordings = ReadRecordings(path, flags.env.value_or(""));
  if (!recordings.ok()) return Annotate(recordings.status(), "--recordings");
  const size_t episodes = recordings->size();
  absl::StatusOr<Dataset> dataset = Concatenate(*std::move(recordings));
  if (!dataset.ok()) return dataset;
  dataset->recipe.erase("parts");  // one for each episode; the names stay
  dataset->recipe["recordings"] = path;
  dataset->recipe["episodes"] = episodes;
  RETURN_IF_ERROR(WeighCorrections(flags, &*dataset));
  return dataset;
}

absl::StatusOr<Dataset> MakeDataset(const DatasetFlags& flags) {
  if (flags.policy_weight.has_value() && !flags.correction_weight.has_value()) {
    return InvalidArgument("--policy_weight", "--correction_weight beside it", "none");
  }
  if (!flags.recordings.empty()) return FromRecordings(flags);
  if (flags.correction_weight.has_value()) {
    return InvalidArgument("--correction_weight", "--recordings beside it", "none");
  }
  RecordFlags record = flags.record;
  record.options.expert.environment = flags.env.value_or(record.options.expert.environment);
  return RecordFromFlags(record, flags.out);
}

absl::Status WriteNewDataset(const DatasetFlags& flags) {
  if (auto status = RequireOut(flags.out, "a .cbor file or a directory to write"); !status.ok()) {
    return status;
  }
  const bool cbor = std::filesystem::path(flags.out).extension() == ".cbor";
  if (!cbor) RETURN_IF_ERROR(MinariId(flags.out).status());  // before it records
  ASSIGN_OR_RETURN(Dataset dataset, MakeDataset(flags));
  dataset.recipe["commit"] = BuildCommit();
  RETURN_IF_ERROR(cbor ? WriteDataset(dataset, flags.out) : WriteMinariDataset(dataset, flags.out));
  nlohmann::ordered_json summary = {{"environment", dataset.environment}};
  summary.update(dataset.recipe);
  std::printf("%s\n", summary.dump(flags.json ? 2 : -1).c_str());
  return absl::OkStatus();
}

}  // namespace

void AddDatasetCommand(Program& program) {
  const Command command =
      program.root().AddCommand("dataset", "Records a dataset, or converts recordings of a server");
  const auto flags = std::make_shared<DatasetFlags>();
  command.Flags("Dataset")
      .Add("out", "FILE", &flags->out, "A .cbor file, or a directory in Minari's layout")
      .Add("env", "ID", &flags->env, kEnvironmentHelp)
      .Add("recordings", "DIR", &flags->recordings,
           "Record directory of a server, or one session of it")
      .Add("correction_weight", "W", &flags->correction_weight,
           "Loss weight of operators' steps; default: all count alike")
      .Add("policy_weight", "W", &flags->policy_weight,
           "Beside it: that of the policy's steps, all others have 0; default: 1")
      .AddSwitch("json", &flags->json, "Print the summary on several lines");
  FlagGroup recording = command.Flags(kRecording);
  recording.Add("seed", "N", &flags->record.options.seed, "Seed of every random draw");
  AddRecordFlags(recording, &flags->record);
  AddTablesFlag(recording, &flags->record.options.expert);
  command.RefuseBeside("recordings", kRecording);
  command.SetAction([flags] { return WriteNewDataset(*flags); });
}

}  // namespace spikeserve
