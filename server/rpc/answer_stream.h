// One bidirectional call that reads a request, answers it, and so on, until the client or the
// server has had enough. After a refusal it rests before it reads on.
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
#include "server/base/status_map.h"
#include "server/rpc/call_tracker.h"
#include "server/rpc/service_parts.h"

namespace spikeserve {

// Keeps itself alive from Begin() until gRPC is done with it. One operation is under way at a time,
// so the messages need no lock; Drain() may come from any thread in between.
template <typename Request, typename Response>
class AnswerStream : public grpc::ServerBidiReactor<Request, Response>, public CallTracker::Stream {
 public:
  // `caller` is what Admit() said. A token that expires later fails the requests that come then.
  AnswerStream(const ServiceParts& parts, absl::StatusOr<const Credential*> caller)
      : parts_(parts), caller_(std::move(caller)) {}

  // Reads the first request of `stream`, or refuses the call where the server drains or the caller
  // was not let in.
  static AnswerStream* Begin(std::shared_ptr<AnswerStream> stream);

  void OnReadDone(bool ok) override;
  void OnWriteDone(bool ok) override;
  void OnDone() override;

  // Ends the call with UNAVAILABLE, after the reply that is under way, if one is.
  void Drain() override;

 protected:
  const ServiceParts& parts() const { return parts_; }
  // REQUIRES: they were let in, or the call would have ended.
  const Credential& caller() const { return **caller_; }

  // Fills in `response`, which is empty, also for a request that fails. Returns what became of the
  // request.
  virtual absl::Status Answer(const Request& request, Response* response,
                              DeferredWork* deferred) = 0;

 private:
  enum class State { kReading, kReplying, kResting, kFinished };

  // Goes on with `next` after the rest, unless the call has ended by then.
  void RestLocked(absl::Duration rest, std::function<void(AnswerStream&)> next)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void ReadLocked() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    state_ = State::kReading;
    this->StartRead(&request_);
  }

  void FinishLocked(const absl::Status& status) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    state_ = State::kFinished;
    this->Finish(ToGrpcStatus(status));
  }

  absl::Duration RestAfter(const absl::Status& status, size_t request_bytes) {
    return parts_.authenticator->RefusalsOf(caller_).DelayFor(status, request_bytes,
                                                              parts_.clock->Now());
  }

  const ServiceParts parts_;
  const absl::StatusOr<const Credential*> caller_;
  std::shared_ptr<AnswerStream> self_;
  Request request_;
  Response response_;
  absl::Duration rest_;  // after the reply that is under way
  grpc::Alarm alarm_;

  absl::Mutex mutex_;  // held for a change of state only, never for a decision
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
    const auto refuse = [status = stream->caller_.status()](AnswerStream& rested) {
      absl::MutexLock again(&rested.mutex_);
      if (rested.state_ == State::kResting) rested.FinishLocked(status);
    };
    stream->RestLocked(stream->RestAfter(stream->caller_.status(), 0), refuse);
  } else if (stream->state_ == State::kReading) {  // else drained since
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
  rest_ = status.ok() ? absl::ZeroDuration() : RestAfter(status, request_.ByteSizeLong());
  this->StartWrite(&response_);
  deferred.Run();
}

template <typename Request, typename Response>
void AnswerStream<Request, Response>::OnWriteDone(bool ok) {
  absl::MutexLock lock(&mutex_);
  if (!ok) return FinishLocked(absl::CancelledError("the client is gone"));
  if (draining_) return FinishLocked(DrainingError());
  if (rest_ == absl::ZeroDuration()) return ReadLocked();
  request_ = Request();  // the next keeps its memory, and this may have been refused for its length
  RestLocked(rest_, [](AnswerStream& rested) {
    absl::MutexLock again(&rested.mutex_);
    if (rested.state_ == State::kResting) rested.ReadLocked();
  });
}

template <typename Request, typename Response>
void AnswerStream<Request, Response>::RestLocked(absl::Duration rest,
                                                 std::function<void(AnswerStream&)> next) {
  state_ = State::kResting;
  alarm_.Set(std::chrono::system_clock::now() + absl::ToChronoNanoseconds(rest),
             [weak = std::weak_ptr<AnswerStream>(self_), next = std::move(next)](bool /*ok*/) {
               if (const auto stream = weak.lock()) next(*stream);
             });
}

template <typename Request, typename Response>
void AnswerStream<Request, Response>::Drain() {
  absl::MutexLock lock(&mutex_);
  draining_ = true;
  if (state_ == State::kReading || state_ == State::kResting) FinishLocked(DrainingError());
}

template <typename Request, typename Response>
void AnswerStream<Request, Response>::OnDone() {
  parts_.calls->EndStream(this);
  const auto last = std::move(self_);  // destroyed on return, unless Drain() is just at work
}

}  // namespace spikeserve

#endif  // SERVER_RPC_ANSWER_STREAM_H_
