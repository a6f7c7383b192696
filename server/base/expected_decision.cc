#include "server/base/expected_decision.h"

#include <string>

#include "absl/strings/cord.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"
#include "google/rpc/error_details.pb.h"

namespace spikeserve {
namespace {

constexpr char kErrorInfoUrl[] = "type.googleapis.com/google.rpc.ErrorInfo";
constexpr char kDecision[] = "expected_decision";
constexpr char kEpisode[] = "expected_episode";
constexpr char kStep[] = "expected_step";

}  // namespace

absl::Status WithExpectedDecision(absl::Status status, const NextDecision& expected) {
  SPIKESERVE_DCHECK(!status.ok());
  google::rpc::ErrorInfo info;
  info.set_reason("OUT_OF_ORDER");
  info.set_domain("spikeserve");
  (*info.mutable_metadata())[kDecision] = absl::StrCat(expected.decision);
  (*info.mutable_metadata())[kEpisode] = absl::StrCat(expected.episode);
  (*info.mutable_metadata())[kStep] = absl::StrCat(expected.step);
  status.SetPayload(kErrorInfoUrl, absl::Cord(info.SerializeAsString()));
  return status;
}

std::optional<NextDecision> ExpectedDecisionOf(const absl::Status& status) {
  const auto payload = status.GetPayload(kErrorInfoUrl);
  google::rpc::ErrorInfo info;
  if (!payload.has_value() || !info.ParseFromString(std::string(*payload))) return std::nullopt;
  const auto read = [&](const char* name, auto* number) {
    const auto found = info.metadata().find(name);
    return found != info.metadata().end() && absl::SimpleAtoi(found->second, number);
  };
  NextDecision expected;
  const bool is_whole = read(kDecision, &expected.decision) && read(kEpisode, &expected.episode) &&
                        read(kStep, &expected.step);
  return is_whole ? std::optional(expected) : std::nullopt;
}

}  // namespace spikeserve
