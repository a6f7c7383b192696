#include <cstdio>
#include <filesystem>

#include "absl/flags/flag.h"
#include "train/commands.h"
#include "train/common_flags.h"
#include "train/minari_file.h"
#include "train/record.h"

namespace spikeserve {

absl::Status DatasetCommand() {
  const absl::StatusOr<std::string> out = RequiredOut("a .cbor file or a directory to write");
  if (!out.ok()) return out.status();
  const absl::StatusOr<RecordOptions> options = RecordOptionsFromFlags();
  if (!options.ok()) return options.status();
  const absl::StatusOr<Dataset> dataset = RecordDataset(*options);
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
