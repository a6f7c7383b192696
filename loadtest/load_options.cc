#include "loadtest/load_options.h"

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

absl::Status CheckRange(absl::string_view flag, int value, int least, int most) {
  if (value >= least && value <= most) return absl::OkStatus();
  return InvalidArgument(absl::StrCat("--", flag), absl::StrCat(least, " to ", most), value);
}

}  // namespace

absl::StatusOr<LoadMode> ParseLoadMode(absl::string_view name) {
  if (name == "unary") return LoadMode::kUnary;
  if (name == "stream") return LoadMode::kStream;
  if (name == "batch") return LoadMode::kBatch;
  return absl::InvalidArgumentError(
      absl::StrCat("expected unary, stream or batch, received \"", name, "\""));
}

absl::StatusOr<v1::Durability> ParseDurability(absl::string_view name) {
  if (name.empty()) return v1::DURABILITY_DEFAULT;
  if (name == "none") return v1::NONE;
  if (name == "async") return v1::ASYNC;
  if (name == "sync") return v1::SYNC;
  return absl::InvalidArgumentError(
      absl::StrCat("expected none, async or sync, received \"", name, "\""));
}

absl::StatusOr<std::optional<v1::LearningConfig::Scope>> ParseLearningScope(
    absl::string_view name) {
  if (name.empty()) return std::nullopt;
  if (name == "session") return v1::LearningConfig::SESSION;
  if (name == "fleet") return v1::LearningConfig::FLEET;
  return absl::InvalidArgumentError(
      absl::StrCat("expected session or fleet, received \"", name, "\""));
}

absl::Status LoadOptions::Validate() const {
  constexpr int kMany = 1'000'000;
  RETURN_IF_ERROR(CheckRange("sessions", sessions, 1, kMany));
  RETURN_IF_ERROR(CheckRange("streams", streams, 1, 1024));
  if (auto status = CheckRange("episode_steps", episode_steps, 1, kMany); !status.ok()) {
    return status;
  }
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
