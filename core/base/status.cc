#include "core/base/status.h"

#include <cerrno>

#include "absl/strings/cord.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {

absl::Status InvalidArgument(const absl::AlphaNum& field, const absl::AlphaNum& expected,
                             const absl::AlphaNum& received) {
  return absl::InvalidArgumentError(
      absl::StrCat(field, ": expected ", expected, ", received ", received));
}

absl::Status SystemError(absl::string_view what, absl::string_view path) {
  return absl::ErrnoToStatus(errno, absl::StrCat(path, ": cannot ", what));
}

absl::Status Annotate(const absl::Status& status, absl::string_view prefix) {
  if (status.ok()) return status;
  absl::Status annotated(status.code(), absl::StrCat(prefix, ": ", status.message()));
  status.ForEachPayload([&annotated](absl::string_view url, const absl::Cord& payload) {
    annotated.SetPayload(url, payload);
  });
  return annotated;
}

}  // namespace spikeserve
