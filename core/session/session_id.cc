#include "core/session/session_id.h"

#include <sys/random.h>

#include <cerrno>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "core/base/json.h"

namespace spikeserve {

absl::StatusOr<std::string> NewSessionId() {
  char bytes[16];
  if (getentropy(bytes, sizeof(bytes)) != 0) return absl::ErrnoToStatus(errno, "getentropy");
  return absl::BytesToHexString(absl::string_view(bytes, sizeof(bytes)));
}

absl::Status NoSuchSession(absl::string_view id) {
  if (id.empty()) {
    return absl::NotFoundError(
        "session_id: expected an open session, received an empty id; is the field set?");
  }
  return absl::NotFoundError(
      absl::StrCat("session_id: expected an open session, received ", Quoted(id)));
}

}  // namespace spikeserve
