#include "loadtest/exchange.h"

#include <algorithm>
#include <chrono>
#include <deque>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/steady_wait.h"

namespace spikeserve {
namespace {

// Sends every request as a call of its own; all calls run concurrently.
class UnaryExchange : public Exchange {
 public:
  explicit UnaryExchange(Client* client) : client_(client) {}

  absl::Status Send(const v1::ActRequest& request) override {
    client_->ActAsync(request, [replies = replies_, id = request.session_id(),
                                step = request.step()](absl::StatusOr<v1::ActResponse> response) {
      replies->Push({id, step, std::move(response), std::chrono::steady_clock::now()});
    });
    return absl::OkStatus();
  }

  absl::StatusOr<ActReply> Receive(absl::Duration timeout) override {
    return replies_->Pop(timeout);
  }

  void Reset() override { replies_ = std::make_shared<Replies>(); }

 private:
  // A queue of answers. Shared with the calls in flight, which may outlive the exchange.
  // Thread-safe.
  class Replies {
   public:
    void Push(ActReply reply) ABSL_LOCKS_EXCLUDED(mutex_) {
      absl::MutexLock lock(&mutex_);
      queue_.push_back(std::move(reply));
      pushed_.NotifyAll();
    }

    absl::StatusOr<ActReply> Pop(absl::Duration timeout) ABSL_LOCKS_EXCLUDED(mutex_) {
      absl::MutexLock lock(&mutex_);
      const auto has_reply = [this]()
                                 ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) { return !queue_.empty(); };
      if (!pushed_.Wait(&mutex_, timeout, has_reply)) {
        return absl::DeadlineExceededError("no reply within " + absl::FormatDuration(timeout));
      }
      ActReply reply = std::move(queue_.front());
      queue_.pop_front();
      return reply;
    }

   private:
    absl::Mutex mutex_;
    SteadyCondition pushed_;
    std::deque<ActReply> queue_ ABSL_GUARDED_BY(mutex_);
  };

  Client* const client_;
  std::shared_ptr<Replies> replies_ = std::make_shared<Replies>();
};

// Sends all requests over one stream.
class StreamExchange : public Exchange {
 public:
  StreamExchange(Client* client, std::shared_ptr<Route> route)
      : client_(client), route_(std::move(route)), stream_(client->OpenStream(route_)) {}

  absl::Status Send(const v1::ActRequest& request) override { return stream_->Send(request); }
  absl::StatusOr<ActReply> Receive(absl::Duration timeout) override {
    return stream_->Receive(timeout);
  }

  void Reset() override { stream_ = client_->OpenStream(route_); }

 private:
  Client* const client_;
  const std::shared_ptr<Route> route_;
  std::unique_ptr<RemoteStream> stream_;
};

// Collects requests and sends them as a batch when an answer is asked for and none is left.
class BatchExchange : public Exchange {
 public:
  BatchExchange(int batch_size, Client* client, std::shared_ptr<Route> route)
      : batch_size_(batch_size), client_(client), route_(std::move(route)) {}

  absl::Status Send(const v1::ActRequest& request) override {
    requests_.push_back(request);
    return absl::OkStatus();
  }

  absl::StatusOr<ActReply> Receive(absl::Duration /*timeout*/) override {
    if (replies_.empty()) CallBatch();
    if (replies_.empty()) return absl::FailedPreconditionError("no request was sent");
    ActReply reply = std::move(replies_.front());
    replies_.pop_front();
    return reply;
  }

  void Reset() override {
    requests_.clear();
    replies_.clear();
  }

 private:
  void CallBatch() {
    const size_t limit = batch_size_ == 0 ? requests_.size() : static_cast<size_t>(batch_size_);
    const auto end = requests_.begin() + std::min(limit, requests_.size());
    const std::vector<v1::ActRequest> batch(requests_.begin(), end);
    requests_.erase(requests_.begin(), end);
    auto results = client_->ActBatch(batch, route_);
    const auto arrived = std::chrono::steady_clock::now();
    for (size_t i = 0; i < batch.size(); ++i) {
      replies_.push_back({batch[i].session_id(), batch[i].step(),
                          results.ok() ? std::move((*results)[i]) : results.status(), arrived});
    }
  }

  const int batch_size_;
  Client* const client_;
  const std::shared_ptr<Route> route_;
  std::deque<v1::ActRequest> requests_;
  std::deque<ActReply> replies_;
};

}  // namespace

std::unique_ptr<Exchange> MakeExchange(LoadMode mode, int batch_size, Client* client,
                                       std::shared_ptr<Route> route) {
  switch (mode) {
    case LoadMode::kUnary:
      return std::make_unique<UnaryExchange>(client);
    case LoadMode::kStream:
      return std::make_unique<StreamExchange>(client, std::move(route));
    case LoadMode::kBatch:
      return std::make_unique<BatchExchange>(batch_size, client, std::move(route));
  }
  return nullptr;  // unreachable: the switch handles every mode
}

}  // namespace spikeserve
