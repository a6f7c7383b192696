#include "spikeserve/status.h"

#include <string>

#include "absl/strings/cord.h"
#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "google/rpc/error_details.pb.h"
#include "google/rpc/status.pb.h"

namespace spikeserve {
namespace {

// URLs of the payloads that a status carries.
constexpr char kRetryInfo[] = "type.googleapis.com/google.rpc.RetryInfo";
constexpr char kErrorInfo[] = "type.googleapis.com/google.rpc.ErrorInfo";
constexpr char kSessionLost[] = "spikeserve.session_lost";
constexpr char kDiverged[] = "spikeserve.diverged";

// In the metadata of ErrorInfo.
constexpr char kExpectedDecision[] = "expected_decision";
constexpr char kExpectedEpisode[] = "expected_episode";

std::optional<uint64_t> ParseNumber(const std::string& text) {
  uint64_t number = 0;
  if (!absl::SimpleAtoi(text, &number)) return std::nullopt;
  return number;
}

// Returns a number in the metadata of the ErrorInfo of a status.
std::optional<uint64_t> NumberIn(const absl::Status& status, const char* name) {
  const auto payload = status.GetPayload(kErrorInfo);
  google::rpc::ErrorInfo info;
  if (!payload.has_value() || !info.ParseFromString(std::string(*payload))) return std::nullopt;
  const auto found = info.metadata().find(name);
  return found == info.metadata().end() ? std::nullopt : ParseNumber(found->second);
}

}  // namespace

absl::Status StatusFromGrpc(const grpc::Status& status) {
  // A proxy resets the calls of a server that has ended: nginx with INTERNAL_ERROR, HAProxy with
  // CANCEL. gRPC makes INTERNAL and CANCELLED of them. UNAVAILABLE shows what they mean.
  const bool is_reset = status.error_code() == grpc::StatusCode::INTERNAL ||
                        status.error_code() == grpc::StatusCode::CANCELLED;
  const auto code = is_reset && absl::StrContains(status.error_message(), "RST_STREAM")
                        ? grpc::StatusCode::UNAVAILABLE
                        : status.error_code();
  absl::Status converted = StatusFromCode(code, status.error_message());
  google::rpc::Status details;
  if (converted.ok() || !details.ParseFromString(status.error_details())) return converted;
  for (const auto& detail : details.details()) {
    for (const char* url : {kRetryInfo, kErrorInfo}) {
      if (detail.type_url() == url) converted.SetPayload(url, absl::Cord(detail.value()));
    }
  }
  return converted;
}

absl::Status StatusFromCode(int32_t code, absl::string_view message,
                            std::optional<double> retry_after_seconds,
                            std::optional<uint64_t> expected_decision,
                            std::optional<int64_t> expected_episode) {
  // The codes of absl have the same numbers as those of gRPC.
  constexpr int32_t kLastCode = static_cast<int32_t>(absl::StatusCode::kUnauthenticated);
  if (code < 0 || code > kLastCode) {
    return absl::UnknownError(absl::StrCat("status code ", code, ": ", message));
  }
  absl::Status status(static_cast<absl::StatusCode>(code), message);
  if (status.ok()) return status;
  if (expected_decision.has_value()) {
    google::rpc::ErrorInfo info;
    (*info.mutable_metadata())[kExpectedDecision] = absl::StrCat(*expected_decision);
    if (expected_episode.has_value()) {
      (*info.mutable_metadata())[kExpectedEpisode] = absl::StrCat(*expected_episode);
    }
    status.SetPayload(kErrorInfo, absl::Cord(info.SerializeAsString()));
  }
  if (!retry_after_seconds.has_value()) return status;
  google::rpc::RetryInfo info;
  absl::Duration rest;
  const absl::Duration delay = absl::Seconds(*retry_after_seconds);
  info.mutable_retry_delay()->set_seconds(absl::IDivDuration(delay, absl::Seconds(1), &rest));
  info.mutable_retry_delay()->set_nanos(static_cast<int32_t>(absl::ToInt64Nanoseconds(rest)));
  status.SetPayload(kRetryInfo, absl::Cord(info.SerializeAsString()));
  return status;
}

std::optional<absl::Duration> RetryAfter(const absl::Status& status) {
  const auto payload = status.GetPayload(kRetryInfo);
  google::rpc::RetryInfo info;
  if (!payload.has_value() || !info.ParseFromString(std::string(*payload))) return std::nullopt;
  return absl::Seconds(info.retry_delay().seconds()) +
         absl::Nanoseconds(info.retry_delay().nanos());
}

std::optional<uint64_t> ExpectedDecision(const absl::Status& status) {
  return NumberIn(status, kExpectedDecision);
}

std::optional<int64_t> ExpectedEpisode(const absl::Status& status) {
  const auto episode = NumberIn(status, kExpectedEpisode);
  return episode.has_value() ? std::optional(static_cast<int64_t>(*episode)) : std::nullopt;
}

std::optional<uint64_t> DivergedAt(const absl::Status& status) {
  const auto payload = status.GetPayload(kDiverged);
  return payload.has_value() ? ParseNumber(std::string(*payload)) : std::nullopt;
}

absl::Status DivergedError(absl::string_view session_id, uint64_t decision) {
  absl::Status status = absl::DataLossError(
      absl::StrCat("session ", session_id, ": expected the answer of decision ", decision,
                   " that was received before, received another one"));
  status.SetPayload(kDiverged, absl::Cord(absl::StrCat(decision)));
  return status;
}

bool IsSessionLost(const absl::Status& status) {
  return status.GetPayload(kSessionLost).has_value();
}

absl::Status ForSession(absl::Status status) {
  if (absl::IsNotFound(status)) status.SetPayload(kSessionLost, absl::Cord());
  return status;
}

}  // namespace spikeserve
