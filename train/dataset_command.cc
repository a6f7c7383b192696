#include <cstdio>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/dataset/recordings.h"
#include "train/commands.h"
#include "train/data/minari_writer.h"
#include "train/evaluation/training_record.h"
#include "train/record_flags.h"

namespace spikeserve {
namespace {

constexpr char kRecording[] = "Recording, without --recordings";

struct DatasetFlags {
  std::string out;
  std::string recordings;          // recordings of a server to convert; empty: record new episodes
  std::optional<std::string> env;  // absent: all environments of the recordings, or CartPole-v1
  RecordFlags record;
  bool json = false;
};

absl::StatusOr<Dataset> FromRecordings(const std::string& path, const std::string& environment) {
  auto recordings = ReadRecordings(path, environment);
  if (!recordings.ok()) return Annotate(recordings.status(), "--recordings");
  const size_t episodes = recordings->size();
  absl::StatusOr<Dataset> dataset = Concatenate(*std::move(recordings));
  if (!dataset.ok()) return dataset;
  dataset->recipe.erase("parts");  // one for each episode; the names stay
  dataset->recipe["recordings"] = path;
  dataset->recipe["episodes"] = episodes;
  return dataset;
}

absl::StatusOr<Dataset> MakeDataset(const DatasetFlags& flags) {
  if (!flags.recordings.empty()) return FromRecordings(flags.recordings, flags.env.value_or(""));
  RecordFlags record = flags.record;
  record.options.expert.environment = flags.env.value_or(record.options.expert.environment);
  return RecordFromFlags(record, flags.out);
}

absl::Status WriteNewDataset(const DatasetFlags& flags) {
  if (auto status = RequireOut(flags.out, "a .cbor file or a directory to write"); !status.ok()) {
    return status;
  }
  ASSIGN_OR_RETURN(Dataset dataset, MakeDataset(flags));
  dataset.recipe["commit"] = BuildCommit();
  const bool cbor = std::filesystem::path(flags.out).extension() == ".cbor";
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
      .AddSwitch("json", &flags->json, "Print the summary on several lines");
  FlagGroup recording = command.Flags(kRecording);
  recording.Add("seed", "N", &flags->record.options.seed, "Seed of every random draw");
  AddRecordFlags(recording, &flags->record);
  AddTablesFlag(recording, &flags->record.options.expert);
  command.RefuseBeside("recordings", kRecording);
  command.SetAction([flags] { return WriteNewDataset(*flags); });
}

}  // namespace spikeserve
