#include "train/evaluation/training_record.h"

#include <openssl/evp.h>

#include <array>
#include <fstream>
#include <memory>
#include <utility>
#include <vector>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/status_macros.h"
#include "train/data/minari_layout.h"
#include "train/data/minari_reader.h"

namespace spikeserve {
namespace {

constexpr std::streamsize kBlockBytes = 1 << 20;

}  // namespace

void AddLineage(const std::string& earlier, nlohmann::ordered_json* record) {
  auto before = nlohmann::ordered_json::parse(earlier, nullptr, /*allow_exceptions=*/false);
  if (!before.is_object() || before.empty()) return;
  (*record)["lineage"] = before.value("lineage", nlohmann::ordered_json::array());
  before.erase("lineage");
  (*record)["lineage"].push_back(std::move(before));
}

absl::StatusOr<std::string> FileSha256(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  const std::unique_ptr<EVP_MD_CTX, decltype(&EVP_MD_CTX_free)> context(EVP_MD_CTX_new(),
                                                                        EVP_MD_CTX_free);
  bool hashed = EVP_DigestInit_ex(context.get(), EVP_sha256(), nullptr) == 1;
  std::vector<char> block(kBlockBytes);  // the file may be larger than the memory
  while (hashed && file.read(block.data(), kBlockBytes).gcount() > 0) {
    hashed = EVP_DigestUpdate(context.get(), block.data(), file.gcount()) == 1;
  }
  if (hashed && !file.eof()) return absl::NotFoundError(absl::StrCat(path, ": no such file"));
  std::array<unsigned char, EVP_MAX_MD_SIZE> digest;
  unsigned int size = 0;
  if (!hashed || EVP_DigestFinal_ex(context.get(), digest.data(), &size) != 1) {
    return absl::InternalError("SHA-256 is not available");
  }
  return absl::BytesToHexString(
      absl::string_view(reinterpret_cast<const char*>(digest.data()), size));
}

absl::StatusOr<nlohmann::ordered_json> IdentifySources(const std::string& parent,
                                                       const std::vector<std::string>& data) {
  nlohmann::ordered_json sources = {{"commit", BuildCommit()}};
  if (!parent.empty()) {
    ASSIGN_OR_RETURN(const std::string sha256, FileSha256(parent));
    sources["parent_sha256"] = sha256;
  }
  for (const std::string& path : data) {
    ASSIGN_OR_RETURN(const std::string sha256,
                     FileSha256(IsMinariDataset(path) ? path + kMinariData : path));
    sources["data_sha256"][path] = sha256;
  }
  return sources;
}

std::string SourceWords(const nlohmann::ordered_json& sources) {
  std::string words;
  if (sources.contains("parent_sha256")) {
    absl::StrAppend(&words, " parent_sha256=", sources["parent_sha256"].get<std::string>());
  }
  if (!sources.contains("data_sha256")) return words;  // recorded anew, which the recipe identifies
  std::vector<std::string> data;
  for (const auto& sha256 : sources["data_sha256"]) data.push_back(sha256.get<std::string>());
  return absl::StrCat(words, " data_sha256=", absl::StrJoin(data, ","));
}

}  // namespace spikeserve
