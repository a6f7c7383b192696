#include <cstdio>
#include <filesystem>
#include <string>
#include <utility>

#include "absl/flags/flag.h"
#include "absl/strings/str_cat.h"
#include "core/dataset/recordings.h"
#include "train/commands.h"
#include "train/common_flags.h"
#include "train/data/minari_file.h"
#include "train/data/record.h"

ABSL_FLAG(
    std::string, recordings, "",
    "dataset: episodes that a server recorded (its --record_dir, or one session in it) instead "
    "of new ones; with --env, only those of it");

namespace spikeserve {
namespace {

absl::StatusOr<Dataset> FromRecordings(const std::string& path) {
  auto recordings = ReadRecordings(path, absl::GetFlag(FLAGS_env).value_or(""));
  if (!recordings.ok()) {
    return absl::Status(recordings.status().code(),
                        absl::StrCat("recordings: ", recordings.status().message()));
  }
  const size_t episodes = recordings->size();
  absl::StatusOr<Dataset> dataset = Concatenate(*std::move(recordings));
  if (dataset.ok()) dataset->recipe = {{"recordings", path}, {"episodes", episodes}};
  return dataset;
}

absl::StatusOr<Dataset> FromExpert() {
  const absl::StatusOr<RecordOptions> options = RecordOptionsFromFlags();
  if (!options.ok()) return options.status();
  return RecordDataset(*options);
}

}  // namespace

absl::Status DatasetCommand() {
  const absl::StatusOr<std::string> out = RequiredOut("a .cbor file or a directory to write");
  if (!out.ok()) return out.status();
  const std::string recordings = absl::GetFlag(FLAGS_recordings);
  const absl::StatusOr<Dataset> dataset =
      recordings.empty() ? FromExpert() : FromRecordings(recordings);
  if (!dataset.ok()) return dataset.status();
  const bool cbor = std::filesystem::path(*out).extension() == ".cbor";
  const absl::Status written =
      cbor ? WriteDataset(*dataset, *out) : WriteMinariDataset(*dataset, *out);
  if (!written.ok()) return written;
  nlohmann::ordered_json summary = {{"environment", dataset->environment}};
  summary.update(dataset->recipe);
  std::printf("%s\n", summary.dump(absl::GetFlag(FLAGS_json) ? 2 : -1).c_str());
  return absl::OkStatus();
}

}  // namespace spikeserve
