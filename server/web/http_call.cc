#include "server/web/http_call.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"
#include "server/transport/grpc_wire.h"
#include "server/transport/transport_budgets.h"

namespace spikeserve {

// The calls of one loop. Confined to its thread.
struct HttpCalls::Loop {
  EventLoop* events;
  CallRouter* router;
  std::map<uint64_t, std::unique_ptr<HttpCall>> calls;
  uint64_t next = 0;
};

class HttpCalls::HttpCall final : public Call {
 public:
  HttpCall(HttpCalls* owner, Loop* loop, uint64_t number, const HttpCallStart& start,
           HttpCallDone done)
      : owner_(*owner),
        loop_(*loop),
        number_(number),
        head_(start.head),
        client_(start.client),
        done_(std::move(done)) {
    head_.deadline = loop->events->now() + start.timeout;
    if (start.timeout == absl::InfiniteDuration()) return;
    deadline_timer_ = loop->events->After(start.timeout, [this] {
      Finish(absl::DeadlineExceededError("the call's deadline has passed"));
    });
  }

  ~HttpCall() override {
    loop_.events->Cancel(deadline_timer_);
    if (handler_ != nullptr) handler_->OnClosed();
    Count(-counted_);
    owner_.calls_.fetch_sub(1, std::memory_order_relaxed);
  }

  void Run(const absl::StatusOr<std::string>& request) {
    loop().thread().AssertCurrent();
    handler_ = loop_.router->Route(this);
    if (finished_ || dropped_) return;
    if (!request.ok()) return Finish(request.status());
    request_bytes_ = static_cast<int64_t>(request->size());
    if (!CountAll()) {
      return Finish(absl::ResourceExhaustedError(
          "the server holds as many bytes of requests as it may, in all or of this caller; try "
          "again later"));
    }
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
  Peer peer() const override { return {.address = client_, .certificate = ""}; }
  void Send(const google::protobuf::MessageLite& message) override {
    if (!finished_) response_ = message.SerializeAsString();
  }
  void SendFramed(std::string framed) override {
    if (!finished_) response_ = framed.substr(std::min(framed.size(), kMessagePrefixBytes));
  }
  void Finish(const absl::Status& status) override {
    loop().thread().AssertCurrent();
    if (std::exchange(finished_, true)) return;
    loop_.events->Cancel(deadline_timer_);
    done_(status.ok() ? absl::StatusOr<std::string>(std::move(response_)) : status);
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
    TransportBudgets& budgets = owner_.transport_.budgets();
    const TransportLimits& limits = owner_.limits_;
    const bool within_group = tenant_ == nullptr
                                  ? budgets.strangers.Count(bytes, limits.max_stranger_bytes)
                                  : tenant_->Count(bytes, limits.max_tenant_bytes);
    return budgets.all.Count(bytes, limits.max_bytes_in_flight) && within_group;
  }

  HttpCalls& owner_;
  Loop& loop_;
  const uint64_t number_;
  CallHead head_;
  const std::string client_;
  const HttpCallDone done_;
  EventLoop::Timer deadline_timer_;
  std::shared_ptr<CallHandler> handler_;
  std::shared_ptr<ByteBudget> tenant_;  // null: a stranger
  std::string response_;
  bool finished_ = false;
  bool dropped_ = false;  // the caller was refused, and learns it after a delay
  int64_t request_bytes_ = 0;
  int64_t held_ = 0;     // by the handler
  int64_t counted_ = 0;  // both
};

HttpCalls::HttpCalls(Transport* transport, const TransportLimits& limits)
    : transport_(*transport), limits_(limits) {
  for (const auto& loop : transport->loops()) {
    loops_.push_back(std::make_unique<Loop>());
    SPIKESERVE_DCHECK(loop->router() != nullptr);
    loops_.back()->events = &loop->events();
    loops_.back()->router = loop->router();
  }
}

HttpCalls::~HttpCalls() = default;

void HttpCalls::Start(HttpCallStart start, HttpCallDone done) {
  if (calls_.fetch_add(1, std::memory_order_relaxed) >= kMostCalls) {
    calls_.fetch_sub(1, std::memory_order_relaxed);
    return done(absl::UnavailableError(
        absl::StrCat("requests: expected at most ", kMostCalls, " at a time; try again later")));
  }
  const uint64_t turn = next_.fetch_add(1, std::memory_order_relaxed);
  Loop& loop = *loops_[turn % loops_.size()];
  loop.events->Post([this, &loop, start = std::move(start), done = std::move(done)]() mutable {
    const uint64_t number = loop.next++;
    auto call = std::make_unique<HttpCall>(this, &loop, number, start, std::move(done));
    HttpCall& started = *call;
    loop.calls.emplace(number, std::move(call));
    started.Run(start.message);
  });
}

}  // namespace spikeserve
