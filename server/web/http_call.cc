#include "server/web/http_call.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "server/access/admission.h"
#include "server/transport/grpc_wire.h"
#include "server/transport/limits.h"
#include "server/transport/transport_budgets.h"

namespace spikeserve {
namespace {

// What one thread reads or writes within about half a millisecond.
constexpr size_t kShortBytes = 16 << 10;

// Of one tenant; the places of HttpCalls are fewer.
constexpr size_t kMostWaiting = 1024;

bool IsShort(const HttpRequest& request) {
  return (request.is_gzip ? request.longest_body : request.body.size()) <= kShortBytes;
}

}  // namespace

struct HttpCalls::Waiting {
  HttpCallStart start;
  HttpCallDone done;
  absl::Duration deadline;  // of the clock
  std::shared_ptr<SharedPlaces::Place> place;

  const std::string& tenant() const { return start.request.caller->tenant()->name(); }
};

// The calls of one loop. Confined to its thread.
struct HttpCalls::Loop {
  EventLoop* events;
  CallRouter* router;
  std::map<uint64_t, std::unique_ptr<HttpCall>> calls;
  uint64_t next = 0;
};

class HttpCalls::HttpCall final : public Call {
 public:
  HttpCall(HttpCalls* owner, Loop* loop, uint64_t number, std::shared_ptr<Waiting> waiting)
      : owner_(*owner), loop_(*loop), number_(number), waiting_(std::move(waiting)) {
    HttpRequest& request = waiting_->start.request;
    head_ = {.path = waiting_->start.method->path,
             .authorization = "",
             .admitted = request.caller,
             .deadline = waiting_->deadline,
             .trace = request.trace};
    if (head_.deadline == absl::InfiniteDuration()) return;
    const absl::Duration left =
        std::max(head_.deadline - loop->events->now(), absl::ZeroDuration());
    deadline_timer_ = loop->events->After(
        left, [this] { Finish(absl::DeadlineExceededError("the call's deadline has passed")); });
  }

  ~HttpCall() override {
    loop_.events->Cancel(deadline_timer_);
    if (handler_ != nullptr) handler_->OnClosed();
    Count(-counted_);
  }

  void Run(const absl::StatusOr<std::string>& request) {
    loop().thread().AssertCurrent();
    handler_ = loop_.router->Route(this);
    if (finished_ || dropped_) return;
    if (!request.ok()) {
      // The caller has used its rate; what it sent is wrong.
      owner_.parts_.metrics->ObserveRpc(*waiting_->start.method, request.status().code(),
                                        absl::ZeroDuration());
      return Finish(request.status());
    }
    request_bytes_ = static_cast<int64_t>(request->size());
    if (!CountAll()) return Finish(TooManyBytesError());
    if (request->size() > handler_->message_limit()) {
      handler_->OnTooLong(request->size());
    } else {
      handler_->OnMessage(*request);
    }
    if (!finished_) handler_->OnHalfClose();
  }

  // Call
  const CallHead& head() const override { return head_; }
  EventLoop& loop() override { return *loop_.events; }
  Peer peer() const override { return waiting_->start.request.peer; }
  void Send(const google::protobuf::MessageLite& message) override {
    if (!finished_) response_ = message.SerializeAsString();
  }
  void SendFramed(std::string framed) override {
    if (finished_) return;
    response_ = std::move(framed);
    response_.erase(0, kMessagePrefixBytes);
  }
  void Finish(const absl::Status& status) override {
    loop().thread().AssertCurrent();
    if (std::exchange(finished_, true)) return;
    loop_.events->Cancel(deadline_timer_);
    owner_.Answer(waiting_,
                  status.ok() ? absl::StatusOr<std::string>(std::move(response_)) : status);
    // The handler may be in the middle of a method.
    loop_.events->Post([loop = &loop_, number = number_] { loop->calls.erase(number); });
  }
  void PauseReading() override {}
  void ResumeReading() override {}
  void DropRequest() override { dropped_ = true; }
  void Admit(std::shared_ptr<ByteBudget> tenant) override {
    const int64_t bytes = counted_;
    Count(-bytes);
    tenant_ = std::move(tenant);
    Count(bytes);
  }
  bool Hold(int64_t bytes) override {
    held_ = bytes;
    return CountAll();
  }

 private:
  bool CountAll() {
    const int64_t all = request_bytes_ + held_;
    return Count(all - std::exchange(counted_, all));
  }

  // Counts `bytes` as the stream of a gRPC call does. Returns false if a limit is exceeded.
  bool Count(int64_t bytes) {
    TransportBudgets& budgets = owner_.parts_.transport->budgets();
    const TransportLimits& limits = owner_.parts_.limits;
    const bool within_group =
        tenant_ == nullptr ? budgets.unauthenticated.Count(bytes, limits.max_unauthenticated_bytes)
                           : tenant_->Count(bytes, limits.max_tenant_bytes);
    return budgets.all.Count(bytes, limits.max_bytes_in_flight) && within_group;
  }

  HttpCalls& owner_;
  Loop& loop_;
  const uint64_t number_;
  CallHead head_;
  const std::shared_ptr<Waiting> waiting_;
  EventLoop::Timer deadline_timer_;
  std::shared_ptr<CallHandler> handler_;
  std::shared_ptr<ByteBudget> tenant_;  // null: unauthenticated
  std::string response_;
  bool finished_ = false;
  bool dropped_ = false;  // the caller was refused, and learns it after a delay
  int64_t request_bytes_ = 0;
  int64_t held_ = 0;     // by the handler
  int64_t counted_ = 0;  // both
};

HttpCalls::HttpCalls(const Parts& parts)
    : parts_(parts),
      places_(kMostCalls),
      short_bodies_(kMostWaiting, BackgroundWorker::Priority::kNormal),
      long_bodies_(kMostWaiting) {
  for (const auto& loop : parts.transport->loops()) {
    loops_.push_back(std::make_unique<Loop>());
    SPIKESERVE_DCHECK(loop->router() != nullptr);
    loops_.back()->events = &loop->events();
    loops_.back()->router = loop->router();
  }
}

HttpCalls::~HttpCalls() = default;

absl::StatusOr<AcceptedBody> HttpCalls::Admit(const HttpRequest& request, const Method& method,
                                              int64_t message_bytes, absl::Duration* delay) {
  const absl::Duration now = parts_.clock->Now();
  const int64_t most = parts_.max_message_bytes;
  const auto caller = spikeserve::Admit(*parts_.authenticator, request.authorization, method);
  absl::Status status = caller.status();
  int64_t refused_bytes = 0;
  if (status.ok()) {
    status = CheckSize(**caller, message_bytes, most);
    if (!status.ok()) refused_bytes = std::min(message_bytes, most);
  }
  if (status.ok()) status = AcquireRate(**caller, method, now);
  if (!status.ok()) {
    parts_.metrics->ObserveRpc(method, status.code(), absl::ZeroDuration());
    *delay = parts_.authenticator->RefusalPacerFor(caller).DelayFor(
        status, static_cast<size_t>(refused_bytes), now);
    return status;
  }
  const std::shared_ptr<Tenant>& tenant = (*caller)->tenant();
  ByteBudget* const all = &parts_.transport->budgets().all;
  return AcceptedBody{
      .longest = static_cast<size_t>(tenant->LongestMessage(most)),
      .caller = *caller,
      .held = std::make_shared<HeldBytes>(
          HeldBytes::Budget{{std::shared_ptr<void>(), all}, parts_.limits.max_bytes_in_flight},
          HeldBytes::Budget{{tenant, &tenant->bytes_in_flight()}, parts_.limits.max_tenant_bytes})};
}

void HttpCalls::Start(HttpCallStart start, HttpCallDone done) {
  SPIKESERVE_DCHECK(start.request.caller != nullptr);
  auto waiting = std::make_shared<Waiting>();
  waiting->deadline = parts_.clock->Now() + start.timeout;
  waiting->start = std::move(start);
  waiting->done = std::move(done);
  waiting->place = places_.Take(waiting->tenant());
  if (waiting->place == nullptr) {
    return waiting->done(absl::UnavailableError(
        "requests: expected fewer at a time of this tenant, which has half of those that are "
        "left; try again later"));
  }
  const auto read = [this, waiting] {
    const HttpRequest& request = waiting->start.request;
    if (request.is_post && request.client.expired()) {
      return waiting->done(absl::CancelledError("the client has left"));
    }
    RunOnLoop(waiting, waiting->start.read(&waiting->start.request));
  };
  if (!waiting->start.request.is_post) return read();
  BackgroundWorker& worker = IsShort(waiting->start.request) ? short_bodies_ : long_bodies_;
  if (auto status = worker.Submit(waiting->tenant(), read); !status.ok()) waiting->done(status);
}

void HttpCalls::RunOnLoop(std::shared_ptr<Waiting> waiting, absl::StatusOr<std::string> message) {
  const uint64_t turn = next_.fetch_add(1, std::memory_order_relaxed);
  Loop& loop = *loops_[turn % loops_.size()];
  loop.events->Post([this, &loop, waiting = std::move(waiting), message = std::move(message)] {
    const uint64_t number = loop.next++;
    auto call = std::make_unique<HttpCall>(this, &loop, number, waiting);
    HttpCall& started = *call;
    loop.calls.emplace(number, std::move(call));
    started.Run(message);
    waiting->start.request.held.reset();  // the call has counted the message
  });
}

void HttpCalls::Answer(const std::shared_ptr<Waiting>& waiting,
                       absl::StatusOr<std::string> response) {
  if (!response.ok() || response->size() <= kShortBytes) return waiting->done(response);
  const auto answer = [waiting, response = std::move(response)] { waiting->done(response); };
  if (auto status = long_bodies_.Submit(waiting->tenant(), answer); !status.ok()) {
    waiting->done(status);
  }
}

}  // namespace spikeserve
