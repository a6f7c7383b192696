#include "server/services/unary_call.h"

#include <google/protobuf/descriptor.h>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/access/admission.h"
#include "server/messages/step_convert.h"
#include "server/services/finite_response.h"
#include "server/services/request_parser.h"
#include "server/transport/limits.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {
namespace {

using google::protobuf::DynamicCastToGenerated;
using google::protobuf::Message;

// In which the messages of a streamed request have to arrive.
constexpr absl::Duration kGatheringTime = absl::Minutes(2);

template <typename... Types>
bool IsOneOf(const Message& message) {
  return ((message.GetDescriptor() == Types::descriptor()) || ...);
}

}  // namespace

void UnaryCall::OnClosed() {
  if (method().gathers) loop().Cancel(gathering_);
  ServiceCall::OnClosed();
}

void UnaryCall::End(CallOutcome outcome) {
  if (!checked_) CheckResponse(&outcome);
  Observe(outcome.status, start_, observed_policy());
  EndSpan(outcome.status, &call_context().span);
  if (call() == nullptr) return;
  // A caller who has to wait for a refusal keeps nothing here, and an answer that waits counts.
  if (!outcome.status.ok()) messages_.Free();
  HoldMessages(framed_bytes()).IgnoreError();
  AfterDelay(outcome.refusal, request_bytes_, [this, status = outcome.status] {
    if (status.ok()) SendResponse();
    Finish(status);
  });
}

absl::Status UnaryCall::HoldMessages(int64_t more) {
  const int64_t held = messages_.extra_bytes() + more;
  return call()->Hold(held) ? absl::OkStatus() : TooManyBytesError();
}

void UnaryCall::CheckResponse(CallOutcome* outcome) {
  // AgentSession has checked the numbers of decisions.
  if (!outcome->status.ok() || IsOneOf<v1::ActBatchResponse>(*response())) return;
  const std::string named = TextOf(*response(), "policy");
  const std::string policy = named.empty() ? TextOf(request(), "policy") : named;
  auto status = CheckFinite(*response(), policy);
  checked_ = true;
  if (status.ok()) return;
  context().metrics->CountNonFiniteAnswer(policy);
  *outcome = CallOutcome(std::move(status));
}

// A session that could not be opened, because the store has it, is missing, too. One that an
// operator wants to steer, with a lease, stays where its robot is.
std::vector<std::string> UnaryCall::MissingSessions(const absl::Status& status) {
  const bool is_in_store =
      absl::IsAlreadyExists(status) && IsOneOf<v1::OpenSessionRequest>(request());
  if (!absl::IsNotFound(status) && !is_in_store) return {};
  const auto& type = *request().GetDescriptor();
  const bool names_session = type.FindFieldByName("session_id") != nullptr;
  if (!names_session || type.FindFieldByName("lease_id") != nullptr) return {};
  return {TextOf(request(), "session_id")};
}

void UnaryCall::HandleAgain(const std::map<std::string, absl::Status>& /*unclaimed*/) {
  response()->Clear();
  checked_ = false;
  Handle();
}

bool UnaryCall::only_reads() const {
  return IsOneOf<v1::GetSessionRequest, v1::ExplainRequest, v1::ExportSessionRequest>(request());
}

void UnaryCall::TakeMerged(const FleetContribution& contribution) {
  const auto merged = contribution.merged();
  if (!merged.has_value()) return;
  if (auto* ended = DynamicCastToGenerated<v1::EndEpisodeResponse>(response())) {
    *ended->mutable_learning() = ToProto(*merged);
  } else if (auto* amended = DynamicCastToGenerated<v1::AmendEpisodeResponse>(response())) {
    *amended->mutable_learning() = ToProto(*merged);
  }
}

void UnaryCall::HandleMessage(absl::string_view message) {
  if (is_refused_) return;
  if (received_ && !method().gathers) {
    return Finish(absl::InternalError("message: expected one request, received a second one"));
  }
  const bool is_first = !std::exchange(received_, true);
  if (is_first) Begin();
  request_bytes_ += message.size();
  const auto status = Read(message, is_first);
  if (!status.ok()) {
    is_refused_ = true;
    return End(status);
  }
  if (!method().gathers) Proceed();
}

absl::Status UnaryCall::Read(absl::string_view message, bool is_first) {
  RETURN_IF_ERROR(
      CheckSize(caller(), static_cast<int64_t>(message.size()), context().max_message_bytes));
  if (is_first) {
    RETURN_IF_ERROR(ParseRequest(message, messages_.request()));
  } else {
    const std::unique_ptr<Message> more(request().New());
    RETURN_IF_ERROR(ParseRequest(message, more.get()));
    messages_.request()->MergeFrom(*more);
  }
  // The arena does not count the content of its strings.
  return HoldMessages(method().gathers ? static_cast<int64_t>(request_bytes_) : 0);
}

void UnaryCall::HandleHalfClose() {
  if (!received_) {
    Finish(absl::InternalError("message: expected one request, received none"));
  } else if (method().gathers && !is_refused_) {
    loop().Cancel(gathering_);
    Proceed();
  }
}

void UnaryCall::Begin() {
  start_ = context().clock->Now();
  call_context().span = StartSpan(call()->head().trace);
  if (!method().gathers) return;
  gathering_ = loop().After(kGatheringTime, [this] {
    is_refused_ = true;
    Finish(absl::DeadlineExceededError(absl::StrCat("message: expected the whole request within ",
                                                    absl::FormatDuration(kGatheringTime),
                                                    ", received a part")));
  });
}

void UnaryCall::Proceed() {
  call_context().caller = &caller();
  call_context().has_paid = call()->head().admitted != nullptr;
  context().sessions->Enter(&call_context());
  Handle();
}

void UnaryCall::HandleTooLong(size_t length, const absl::Status& error) {
  if (is_refused_) return;
  start_ = context().clock->Now();
  request_bytes_ = length;
  received_ = true;
  is_refused_ = true;
  End(error);
}

}  // namespace spikeserve
