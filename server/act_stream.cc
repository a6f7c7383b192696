#include "server/act_stream.h"

#include <utility>

#include "server/admission.h"
#include "server/convert.h"
#include "server/status_map.h"

namespace spikeserve {

ActStream* ActStream::Start(const ServiceParts& parts, const grpc::CallbackServerContext& context) {
  const auto stream = std::shared_ptr<ActStream>(
      new ActStream(parts, Admit(*parts.authenticator, context, Method::kActStream)));
  stream->self_ = stream;
  const bool accepted = parts.calls->BeginStream(stream);
  absl::MutexLock lock(&stream->mutex_);
  if (!accepted) {
    stream->FinishLocked(DrainingError());
  } else if (!stream->caller_.ok()) {
    stream->FinishLocked(stream->caller_.status());
  } else if (stream->state_ == State::kReading) {  // else drained since
    stream->StartRead(&stream->request_);
  }
  return stream.get();
}

void ActStream::OnReadDone(bool ok) {
  {
    absl::MutexLock lock(&mutex_);
    if (state_ == State::kFinished) return;
    if (!ok) return FinishLocked(absl::OkStatus());  // the client has no more requests
    state_ = State::kReplying;
  }
  DeferredWork deferred;
  Answer(&deferred);
  StartWrite(&response_);
  deferred.Run();
}

absl::Status ActStream::Handle(DeferredWork* deferred) {
  const Credential& caller = **caller_;
  if (auto status = caller.CheckValid(); !status.ok()) return status;
  if (auto status = CheckSize(caller, request_); !status.ok()) return status;
  return parts_.handler->Act(caller, request_, &response_, deferred);
}

void ActStream::Answer(DeferredWork* deferred) {
  const absl::Duration start = parts_.clock->Now();
  response_.Clear();
  const absl::Status status = Handle(deferred);
  if (!status.ok()) ErrorToProto(request_, status, &response_);
  parts_.metrics->ObserveRpc(Method::kActStream, status.code(), parts_.clock->Now() - start);
}

void ActStream::OnWriteDone(bool ok) {
  absl::MutexLock lock(&mutex_);
  if (!ok) return FinishLocked(absl::CancelledError("the client is gone"));
  if (draining_) return FinishLocked(DrainingError());
  state_ = State::kReading;
  StartRead(&request_);
}

void ActStream::Drain() {
  absl::MutexLock lock(&mutex_);
  draining_ = true;
  if (state_ == State::kReading) FinishLocked(DrainingError());
}

void ActStream::FinishLocked(const absl::Status& status) {
  state_ = State::kFinished;
  Finish(ToGrpcStatus(status));
}

void ActStream::OnDone() {
  parts_.calls->EndStream(this);
  const auto last = std::move(self_);  // destroyed on return, unless Drain() is just at work
}

}  // namespace spikeserve
