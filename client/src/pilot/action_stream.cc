#include "client/src/pilot/action_stream.h"

#include <utility>

#include "spikeserve/status.h"

namespace spikeserve::piloting {

ActionStream::ActionStream(RenewableConnection* connection, const Route& route, Listener* listener)
    : connection_(connection),
      listener_(listener),
      watched_(connection, &context_, /*expects_answer=*/false) {
  context_.AddMetadata(kAffinityKey, route.key);
  watched_.line().stub->async()->ActStream(&context_, this);
  // Writes start outside of gRPC's callbacks. The hold keeps gRPC from ending the call before them.
  AddHold();
  StartRead(&incoming_);
  StartCall();
}

ActionStream::~ActionStream() {
  context_.TryCancel();
  absl::MutexLock lock(&mutex_);
  mutex_.Await(absl::Condition(&is_done_));
}

void ActionStream::Send(v1::ActRequest request) {
  absl::MutexLock lock(&mutex_);
  if (has_ended_) return;
  outgoing_.push_back(std::move(request));
  if (outgoing_.size() == 1) StartWrite(&outgoing_.front());
}

void ActionStream::OnReadDone(bool ok) {
  if (ok) {
    listener_->OnReply(incoming_);
    incoming_.Clear();
    StartRead(&incoming_);
    return;
  }
  absl::MutexLock lock(&mutex_);
  has_ended_ = true;
  RemoveHold();
}

void ActionStream::OnWriteDone(bool ok) {
  absl::MutexLock lock(&mutex_);
  if (!ok || has_ended_) return;  // OnDone follows
  outgoing_.pop_front();
  if (!outgoing_.empty()) StartWrite(&outgoing_.front());
}

void ActionStream::OnDone(const grpc::Status& status) {
  listener_->OnEnd(StatusFromGrpc(status));
  absl::MutexLock lock(&mutex_);
  is_done_ = true;
}

}  // namespace spikeserve::piloting
