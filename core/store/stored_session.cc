#include "core/store/stored_session.h"

#include "core/digest/sha256.h"

namespace spikeserve {

std::string SecondStoredId(absl::string_view tenant, absl::string_view id) {
  // An id has a fixed length, so that no two pairs are the same text.
  return Sha256Of(absl::StrCat(id, tenant)).substr(0, kStoredIdBytes);
}

}  // namespace spikeserve
