#include "loadtest/load_options.h"

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

absl::Status CheckRange(absl::string_view flag, int value, int least, int most) {
  if (value >= least && value <= most) return absl::OkStatus();
  return InvalidArgument(absl::StrCat("--", flag), absl::StrCat(least, " to ", most), value);
}

}  // namespace

absl::Status LoadOptions::Validate() const {
  constexpr int kMany = 1'000'000;
  RETURN_IF_ERROR(CheckRange("sessions", sessions, 1, kMany));
  RETURN_IF_ERROR(CheckRange("streams", streams, 1, 1024));
  RETURN_IF_ERROR(CheckRange("episode_steps", episode_steps, 1, kMany));
  RETURN_IF_ERROR(CheckRange("batch_size", batch_size, 0, kMany));
  if (!(observation_bound >= 0.0 && observation_bound <= 1e6)) {
    return InvalidArgument("--observation_bound", "0 to 1e6", observation_bound);
  }
  if (!(rate >= 0.0 && rate <= 1e7)) {
    return InvalidArgument("--rate", "0 to 1e7", rate);
  }
  if (pause_after_error < absl::ZeroDuration() || pause_after_error > absl::Hours(1)) {
    return InvalidArgument("--pause_after_error", "0 to 1h",
                           absl::FormatDuration(pause_after_error));
  }
  if (duration <= absl::ZeroDuration() || duration > absl::Hours(24)) {
    return InvalidArgument("--duration", "more than 0 and at most 24h",
                           absl::FormatDuration(duration));
  }
  if (call_timeout <= absl::ZeroDuration() || call_timeout > absl::Hours(1)) {
    return InvalidArgument("--call_timeout", "more than 0 and at most 1h",
                           absl::FormatDuration(call_timeout));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
