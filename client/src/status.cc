#include "spikeserve/status.h"

#include "absl/strings/str_cat.h"

namespace spikeserve {

absl::Status StatusFromGrpc(const grpc::Status& status) {
  return StatusFromCode(status.error_code(), status.error_message());
}

absl::Status StatusFromCode(int32_t code, absl::string_view message) {
  // The codes of absl have the same numbers as those of gRPC.
  constexpr int32_t kLastCode = static_cast<int32_t>(absl::StatusCode::kUnauthenticated);
  if (code < 0 || code > kLastCode) {
    return absl::UnknownError(absl::StrCat("status code ", code, ": ", message));
  }
  return absl::Status(static_cast<absl::StatusCode>(code), message);
}

}  // namespace spikeserve
