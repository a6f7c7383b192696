#include "server/options.h"

#include "absl/strings/str_cat.h"
#include "server/address.h"

namespace spikeserve {

absl::Status ServerOptions::Validate() const {
  if (policies.empty()) {
    return absl::InvalidArgumentError("--policies: expected a directory, received none");
  }
  if (auto address = ParseAddress("--listen", listen); !address.ok()) return address.status();
  if (!http_listen.empty()) {
    if (auto address = ParseAddress("--http_listen", http_listen); !address.ok()) {
      return address.status();
    }
  }
  if (session_ttl < absl::Milliseconds(1)) {
    return absl::InvalidArgumentError(absl::StrCat(
        "--session_ttl: expected at least 1ms, received ", absl::FormatDuration(session_ttl)));
  }
  if (poll_policies != absl::ZeroDuration() && poll_policies < absl::Milliseconds(1)) {
    return absl::InvalidArgumentError(
        absl::StrCat("--poll_policies: expected 0 or at least 1ms, received ",
                     absl::FormatDuration(poll_policies)));
  }
  if (compact_after < absl::Milliseconds(1)) {
    return absl::InvalidArgumentError(absl::StrCat(
        "--compact_after: expected at least 1ms, received ", absl::FormatDuration(compact_after)));
  }
  if (max_sessions < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("--max_sessions: expected at least 1, received ", max_sessions));
  }
  if (drain_timeout < absl::ZeroDuration()) {
    return absl::InvalidArgumentError(
        absl::StrCat("--drain_timeout: expected a duration of at least 0, received ",
                     absl::FormatDuration(drain_timeout)));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
