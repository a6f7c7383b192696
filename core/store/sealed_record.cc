#include "core/store/sealed_record.h"

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/digest/sha256.h"

namespace spikeserve {
namespace {

// Stands between the record and its checksum. No CBOR document ends with it and 8 more bytes by
// accident.
constexpr absl::string_view kMark = "\xff sum ";
constexpr size_t kChecksumBytes = 8;  // of the SHA-256

std::string ChecksumOf(absl::string_view record) {
  return std::string(reinterpret_cast<const char*>(Sha256BytesOf(record).data()), kChecksumBytes);
}

}  // namespace

std::string SealRecord(absl::string_view record) {
  return absl::StrCat(record, kMark, ChecksumOf(record));
}

std::string OpenRecord(absl::string_view bytes) {
  constexpr size_t kSealBytes = kMark.size() + kChecksumBytes;
  if (bytes.size() < kSealBytes) return std::string(bytes);
  const absl::string_view record = bytes.substr(0, bytes.size() - kSealBytes);
  const absl::string_view seal = bytes.substr(record.size());
  if (!absl::StartsWith(seal, kMark)) return std::string(bytes);
  return std::string(seal.substr(kMark.size()) == ChecksumOf(record) ? record : "");
}

std::string DamagedRecord() { return absl::StrCat(kMark, std::string(kChecksumBytes, '\0')); }

absl::Status CutDamagedEnd(std::vector<std::string>* journal) {
  const size_t size = journal->size();
  while (journal->size() > 1 && journal->back().empty()) journal->pop_back();
  if (journal->size() == size) return absl::OkStatus();
  return absl::DataLossError(absl::StrCat("journal: record ", journal->size(), " of ", size,
                                          ": expected its checksum, received another one"));
}

}  // namespace spikeserve
