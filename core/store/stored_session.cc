#include "core/store/stored_session.h"

#include <openssl/sha.h>

#include "absl/strings/escaping.h"

namespace spikeserve {

std::string SecondStoredId(absl::string_view tenant, absl::string_view id) {
  // An id has a fixed length, so that no two pairs are the same text.
  const std::string both = absl::StrCat(id, tenant);
  unsigned char digest[SHA256_DIGEST_LENGTH];
  SHA256(reinterpret_cast<const unsigned char*>(both.data()), both.size(), digest);
  return absl::BytesToHexString(
      absl::string_view(reinterpret_cast<const char*>(digest), kStoredIdBytes / 2));
}

}  // namespace spikeserve
