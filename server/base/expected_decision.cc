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

}  // namespace

absl::Status WithExpectedDecision(absl::Status status, uint64_t decision, int64_t step) {
  SPIKESERVE_DCHECK(!status.ok());
  google::rpc::ErrorInfo info;
  info.set_reason("OUT_OF_ORDER");
  info.set_domain("spikeserve");
  (*info.mutable_metadata())[kDecision] = absl::StrCat(decision);
  (*info.mutable_metadata())["expected_step"] = absl::StrCat(step);
  status.SetPayload(kErrorInfoUrl, absl::Cord(info.SerializeAsString()));
  return status;
}

std::optional<uint64_t> ExpectedDecision(const absl::Status& status) {
  const auto payload = status.GetPayload(kErrorInfoUrl);
  google::rpc::ErrorInfo info;
  if (!payload.has_value() || !info.ParseFromString(std::string(*payload))) return std::nullopt;
  uint64_t decision = 0;
  const auto found = info.metadata().find(kDecision);
  const bool is_number =
      found != info.metadata().end() && absl::SimpleAtoi(found->second, &decision);
  return is_number ? std::optional(decision) : std::nullopt;
}

}  // namespace spikeserve
