// A bidirectional call that answers one request at a time, until the client ends the call or the
// server drains. After a refusal it waits before it reads the next request.
#ifndef SERVER_RPC_ANSWER_STREAM_H_
#define SERVER_RPC_ANSWER_STREAM_H_

#include <grpcpp/alarm.h>
#include <grpcpp/support/server_callback.h>

#include <chrono>
#include <functional>
#include <memory>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "server/access/authenticator.h"
#include "server/agent/deferred_work.h"
#include "server/rpc/call_tracker.h"
#include "server/rpc/service_parts.h"
#include "server/rpc/status_map.h"

namespace spikeserve {

// The state machine of one call: read a request, answer it, write the reply, read the next one.
// Derived classes implement Answer().
//
//   return AnswerStream::Begin(std::make_shared<ActStream>(parts, caller, handler));
//
// Keeps itself alive from Begin() until OnDone(). One operation runs at a time, so the messages
// need no lock. Drain() is thread-safe; gRPC calls the On...() methods.
template <typename Request, typename Response>
class AnswerStream : public grpc::ServerBidiReactor<Request, Response>, public CallTracker::Stream {
 public:
  // `caller` is the result of Admit(). If the token expires later, the requests that follow fail.
  AnswerStream(const ServiceParts& parts, absl::StatusOr<const Credential*> caller)
      : parts_(parts), caller_(std::move(caller)) {}

  // Starts the call: reads the first request, or refuses the call if the server drains or the
  // caller was not admitted.
  static AnswerStream* Begin(std::shared_ptr<AnswerStream> stream);

  void OnReadDone(bool ok) override;
  void OnWriteDone(bool ok) override;
  void OnDone() override;

  // Ends the call with UNAVAILABLE. A reply that is being written is sent first.
  void Drain() override;

 protected:
  const ServiceParts& parts() const { return parts_; }
  // REQUIRES: the caller was admitted, which holds in every call of Answer().
  const Credential& caller() const { return **caller_; }

  // Answers one request. Fills in `response`, which is empty before, also if the request fails.
  // Returns the status of the request, which decides how long the next read is delayed.
  virtual absl::Status Answer(const Request& request, Response* response,
                              DeferredWork* deferred) = 0;

 private:
  enum class State { kReading, kReplying, kDelaying, kFinished };

  // Calls `next` after `delay`, unless the call has ended by then.
  void DelayLocked(absl::Duration delay, std::function<void(AnswerStream&)> next)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void ReadLocked() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    state_ = State::kReading;
    this->StartRead(&request_);
  }

  void FinishLocked(const absl::Status& status) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    state_ = State::kFinished;
    this->Finish(ToGrpcStatus(status));
  }

  absl::Duration DelayAfter(const absl::Status& status, size_t request_bytes) {
    return parts_.authenticator->RefusalPacerFor(caller_).DelayFor(status, request_bytes,
                                                                   parts_.clock->Now());
  }

  const ServiceParts parts_;
  const absl::StatusOr<const Credential*> caller_;
  std::shared_ptr<AnswerStream> self_;
  Request request_;
  Response response_;
  absl::Duration delay_;  // between the current reply and the next read
  grpc::Alarm alarm_;

  absl::Mutex mutex_;  // held only while the state changes, never during a decision
  State state_ ABSL_GUARDED_BY(mutex_) = State::kReading;
  bool draining_ ABSL_GUARDED_BY(mutex_) = false;
};

template <typename Request, typename Response>
AnswerStream<Request, Response>* AnswerStream<Request, Response>::Begin(
    std::shared_ptr<AnswerStream> stream) {
  stream->self_ = stream;
  const bool accepted = stream->parts_.calls->BeginStream(stream);
  absl::MutexLock lock(&stream->mutex_);
  if (!accepted) {
    stream->FinishLocked(DrainingError());
  } else if (!stream->caller_.ok()) {
    const auto refuse = [status = stream->caller_.status()](AnswerStream& delayed) {
      absl::MutexLock again(&delayed.mutex_);
      if (delayed.state_ == State::kDelaying) delayed.FinishLocked(status);
    };
    stream->DelayLocked(stream->DelayAfter(stream->caller_.status(), 0), refuse);
  } else if (stream->state_ == State::kReading) {  // otherwise Drain() has ended the call already
    stream->StartRead(&stream->request_);
  }
  return stream.get();
}

template <typename Request, typename Response>
void AnswerStream<Request, Response>::OnReadDone(bool ok) {
  {
    absl::MutexLock lock(&mutex_);
    if (state_ == State::kFinished) return;
    if (!ok) return FinishLocked(absl::OkStatus());  // the client has no more requests
    state_ = State::kReplying;
  }
  DeferredWork deferred;
  response_.Clear();
  const absl::Status status = Answer(request_, &response_, &deferred);
  delay_ = status.ok() ? absl::ZeroDuration() : DelayAfter(status, request_.ByteSizeLong());
  this->StartWrite(&response_);
  deferred.Run();
}

template <typename Request, typename Response>
void AnswerStream<Request, Response>::OnWriteDone(bool ok) {
  absl::MutexLock lock(&mutex_);
  if (!ok) return FinishLocked(absl::CancelledError("the client has disconnected"));
  if (draining_) return FinishLocked(DrainingError());
  if (delay_ == absl::ZeroDuration()) return ReadLocked();
  // Frees the request's memory, which the next read would reuse: it may have been refused for its
  // length.
  request_ = Request();
  DelayLocked(delay_, [](AnswerStream& delayed) {
    absl::MutexLock again(&delayed.mutex_);
    if (delayed.state_ == State::kDelaying) delayed.ReadLocked();
  });
}

template <typename Request, typename Response>
void AnswerStream<Request, Response>::DelayLocked(absl::Duration delay,
                                                  std::function<void(AnswerStream&)> next) {
  state_ = State::kDelaying;
  alarm_.Set(std::chrono::system_clock::now() + absl::ToChronoNanoseconds(delay),
             [weak = std::weak_ptr<AnswerStream>(self_), next = std::move(next)](bool /*ok*/) {
               if (const auto stream = weak.lock()) next(*stream);
             });
}

template <typename Request, typename Response>
void AnswerStream<Request, Response>::Drain() {
  absl::MutexLock lock(&mutex_);
  draining_ = true;
  if (state_ == State::kReading || state_ == State::kDelaying) FinishLocked(DrainingError());
}

template <typename Request, typename Response>
void AnswerStream<Request, Response>::OnDone() {
  parts_.calls->EndStream(this);
  const auto last = std::move(self_);  // destroyed on return, or when a running Drain() returns
}

}  // namespace spikeserve

#endif  // SERVER_RPC_ANSWER_STREAM_H_
