#include "server/services/service_call.h"

#include <utility>

#include "core/contract/dcheck.h"
#include "server/access/admission.h"

namespace spikeserve {
void ServiceCall::Start() {
  SPIKESERVE_DCHECK(call_ != nullptr && !caller_.ok());  // called once, before the call is over
  const absl::Duration start = context_.clock->Now();
  const CallHead& head = call_->head();
  if (admission_.ok() && head.admitted != nullptr) {
    caller_ = head.admitted;
    admission_ = caller().CheckValid();
  } else if (admission_.ok()) {
    caller_ = Admit(*context_.authenticator, head.authorization, method_);
    admission_ =
        caller_.ok() ? caller().tenant()->AcquireCall(method_.cost, start) : caller_.status();
  }
  if (admission_.ok()) {
    const std::shared_ptr<Tenant>& tenant = caller().tenant();
    return call_->Admit(std::shared_ptr<ByteBudget>(tenant, &tenant->bytes_in_flight()));
  }
  // Refused before a byte of the request was read.
  call_->DropRequest();
  Observe(admission_, start);
  AfterDelay(admission_, /*request_bytes=*/0, [this] { Finish(admission_); });
}

void ServiceCall::OnMessage(absl::string_view message) {
  SPIKESERVE_DCHECK(admission_.ok());
  caller().tenant()->CountReceived(static_cast<int64_t>(message.size()));
  HandleMessage(message);
}

void ServiceCall::OnTooLong(size_t length) {
  SPIKESERVE_DCHECK(admission_.ok());
  HandleTooLong(length,
                CheckSize(caller(), static_cast<int64_t>(length), context_.max_message_bytes));
}

void ServiceCall::OnHalfClose() {
  if (admission_.ok()) HandleHalfClose();
}

void ServiceCall::OnClosed() {
  call_->loop().Cancel(timer_);
  delayed_ = nullptr;
  call_ = nullptr;
}

void ServiceCall::OnDrain() {
  // A caller that waits for its refusal need not wait longer.
  if (delayed_ == nullptr || call_ == nullptr) return;
  call_->loop().Cancel(timer_);
  std::exchange(delayed_, nullptr)();
}

absl::Duration ServiceCall::DelayFor(const absl::Status& status, size_t request_bytes) const {
  if (status.ok()) return absl::ZeroDuration();  // without a look at the clock
  return context_.authenticator->RefusalPacerFor(caller_).DelayFor(status, request_bytes,
                                                                   context_.clock->Now());
}

void ServiceCall::AfterDelay(const absl::Status& status, size_t request_bytes,
                             std::function<void()> next) {
  SPIKESERVE_DCHECK(call_ != nullptr);
  SPIKESERVE_DCHECK(!is_delayed());
  const absl::Duration delay = DelayFor(status, request_bytes);
  if (delay == absl::ZeroDuration()) return next();
  delayed_ = std::move(next);
  timer_ = call_->loop().After(delay, [this] { std::exchange(delayed_, nullptr)(); });
}

void ServiceCall::PauseAfter(const absl::Status& status, size_t request_bytes) {
  SPIKESERVE_DCHECK(call_ != nullptr);
  const absl::Duration delay = DelayFor(status, request_bytes);
  if (delay == absl::ZeroDuration()) return;
  call_->PauseReading();
  call_->loop().Cancel(timer_);
  delayed_ = [this] { call_->ResumeReading(); };
  timer_ = call_->loop().After(delay, [this] { std::exchange(delayed_, nullptr)(); });
}

void ServiceCall::Finish(const absl::Status& status) {
  loop_.thread().AssertCurrent();
  if (call_ != nullptr) call_->Finish(status);
}

}  // namespace spikeserve
