#include "server/services/datagram_calls.h"

#include <cstdint>
#include <optional>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "server/access/admission.h"
#include "server/messages/step_convert.h"
#include "server/services/request_parser.h"
#include "server/services/request_span.h"
#include "server/transport/limits.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {
namespace {

constexpr size_t kNumberBytes = 8;

// Of the requests of all tenants that wait.
constexpr int64_t kMostBytes = 64 << 20;

}  // namespace

// One request, from its arrival to its answer.
class DatagramCalls::Request final : public QueuedAct {
 public:
  Request(DatagramCalls* calls, std::shared_ptr<DatagramKey> key, absl::string_view number)
      : QueuedAct(&calls->context_, &calls->queue_),
        calls_(*calls),
        key_(std::move(key)),
        number_(number),
        admission_(calls->context_.gate->Begin()) {}
  ~Request() override {
    calls_.CountBytes(*key_->caller().tenant(), -kHeldBytes);
    key_->Leave();
    calls_.context_.gate->End();
  }

  void Handle(absl::string_view message) {
    const Credential& caller = key_->caller();
    auto status = ParseRequest(message, request());
    if (status.ok() && request()->session_id() != key_->session_id()) {
      status =
          InvalidArgument("session_id", absl::StrCat("that of the channel, ", key_->session_id()),
                          request()->session_id());
    }
    const ServiceContext& context = calls_.context_;
    if (context.tracer != nullptr) {
      call_context().span = StartRequestSpan(*context.tracer, calls_.method_.path,
                                             ParseTraceParent(request()->traceparent()));
      call_context().span.Set("network.transport", "udp");
    }
    if (status.ok()) status = admission_;
    if (status.ok()) {
      status = CheckStillAdmitted(caller, static_cast<int64_t>(message.size()),
                                  context.max_message_bytes);
    }
    if (!calls_.CountBytes(*caller.tenant(), kHeldBytes) && status.ok()) {
      status = TooManyBytesError();
    }
    if (!status.ok()) return Answer(status);
    call_context().is_datagram = true;
    Enter(&caller);
  }

 private:
  void Send(const absl::Status& status) override {
    const ServiceContext& context = calls_.context_;
    const absl::Duration now = context.clock->Now();
    const Credential& caller = key_->caller();
    if (call_context().span) FinishRequestSpan(caller, status, &call_context().span);
    context.metrics->ObserveRpc(calls_.method_, status.code(), now - act().received, act().policy);
    const absl::Duration delay = caller.tenant()->refusals().DelayFor(status, kDatagramBytes, now);
    if (delay > absl::ZeroDuration()) key_->DelayUntil(now + delay);
    // The session has moved on, and its keys with it.
    if (absl::IsNotFound(status)) return calls_.channels_.Remove(*key_);
    if (!status.ok()) ErrorToProto(*request(), status, response());
    std::string payload = absl::StrCat(number_, response()->SerializeAsString());
    if (payload.size() > kDatagramPayloadBytes) {
      response()->Clear();
      ErrorToProto(*request(),
                   absl::OutOfRangeError(absl::StrCat(
                       "answer: expected at most ", kDatagramPayloadBytes,
                       " bytes in a datagram, has ", payload.size(), "; ask on the stream")),
                   response());
      payload = absl::StrCat(number_, response()->SerializeAsString());
    }
    DatagramKey::Answers answers;
    key_->Answer(number_, std::move(payload), &answers);
    calls_.Send(std::move(answers));
  }

  static constexpr int64_t kHeldBytes = QueuedAct::kBytes + kDatagramBytes;

  DatagramCalls& calls_;
  const std::shared_ptr<DatagramKey> key_;
  const std::string number_;  // of the request, as it arrived
  const absl::Status admission_;
};

DatagramCalls::DatagramCalls(const ServiceContext* context, ActQueue* queue, TransportLoop* loop,
                             int64_t max_tenant_bytes)
    : context_(*context),
      channels_(*context->datagrams),
      queue_(*queue),
      loop_(*loop),
      max_tenant_bytes_(max_tenant_bytes),
      method_(MethodNamed("ActStream")) {}

absl::Status DatagramCalls::Start() {
  return loop_.datagrams()->Start(
      [this](const SocketAddress& from, absl::string_view datagram) { Receive(from, datagram); });
}

void DatagramCalls::Receive(const SocketAddress& from, absl::string_view datagram) {
  const std::optional<uint64_t> id = KeyIdOf(datagram);
  if (!id.has_value()) return channels_.Count(DatagramOutcome::kMalformed);
  const auto key = channels_.Find(*id);
  channels_.Count(key == nullptr ? DatagramOutcome::kUnknownKey : Take(key, from, datagram));
}

DatagramOutcome DatagramCalls::Take(const std::shared_ptr<DatagramKey>& key,
                                    const SocketAddress& from, absl::string_view datagram) {
  std::string payload;
  const DatagramOutcome outcome = key->Open(datagram, from, &payload);
  if (outcome != DatagramOutcome::kTaken) return outcome;
  if (payload.size() < kNumberBytes) return DatagramOutcome::kMalformed;
  const absl::string_view text = payload;
  DatagramKey::Answers answers;
  if (key->IsCopy(text.substr(0, kNumberBytes), &answers)) {
    Send(std::move(answers));
    return outcome;
  }
  if (!key->Enter(context_.clock->Now())) return DatagramOutcome::kRefused;
  std::make_shared<Request>(this, key, text.substr(0, kNumberBytes))
      ->Handle(text.substr(kNumberBytes));
  return outcome;
}

void DatagramCalls::Send(DatagramKey::Answers answers) {
  for (std::string& datagram : answers.datagrams) {
    loop_.datagrams()->Send(answers.to, std::move(datagram));
  }
}

bool DatagramCalls::CountBytes(Tenant& tenant, int64_t bytes) {
  const bool fits_tenant = tenant.bytes_in_flight().Count(bytes, max_tenant_bytes_);
  return channels_.bytes_in_flight().Count(bytes, kMostBytes) && fits_tenant;
}

}  // namespace spikeserve
