#include "train/evaluation/training_record.h"

#include <openssl/evp.h>

#include <array>
#include <utility>

#include "absl/strings/escaping.h"
#include "core/base/file.h"

namespace spikeserve {

void AddLineage(const std::string& earlier, nlohmann::ordered_json* record) {
  auto before = nlohmann::ordered_json::parse(earlier, nullptr, /*allow_exceptions=*/false);
  if (!before.is_object() || before.empty()) return;
  (*record)["lineage"] = before.value("lineage", nlohmann::ordered_json::array());
  before.erase("lineage");
  (*record)["lineage"].push_back(std::move(before));
}

absl::StatusOr<std::string> FileSha256(const std::string& path) {
  const absl::StatusOr<std::string> bytes = ReadFile(path);
  if (!bytes.ok()) return bytes.status();
  std::array<char, EVP_MAX_MD_SIZE> digest;
  unsigned int size = 0;
  if (EVP_Digest(bytes->data(), bytes->size(), reinterpret_cast<unsigned char*>(digest.data()),
                 &size, EVP_sha256(), nullptr) != 1) {
    return absl::InternalError("SHA-256 is not available");
  }
  return absl::BytesToHexString(absl::string_view(digest.data(), size));
}

}  // namespace spikeserve
