#include "server/services/health_service.h"

#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "server/services/call_gate.h"
#include "server/services/request_parser.h"

namespace spikeserve {
namespace {

constexpr size_t kMessageLimit = 4096;  // a request is the name of a service

}  // namespace

// What the two calls share: the name of a service, received in one message.
class HealthService::CheckCall : public CallHandler {
 public:
  CheckCall(HealthService* service, Call* call) : service_(*service), call_(call) {}

  size_t message_limit() const override { return kMessageLimit; }

  void OnMessage(absl::string_view message) override {
    received_ = true;
    grpc::health::v1::HealthCheckRequest request;
    if (auto status = ParseRequest(message, &request); !status.ok()) {
      return call_->Finish(status);
    }
    Answer(request.service());
  }
  void OnTooLong(size_t length) override {
    call_->Finish(absl::ResourceExhaustedError(
        absl::StrCat("message: expected at most ", kMessageLimit, " bytes, received ", length)));
  }
  void OnHalfClose() override {
    if (received_) return;
    call_->Finish(absl::InternalError("message: expected one request, received none"));
  }
  void OnClosed() override { call_ = nullptr; }
  void OnDrain() override {}

 protected:
  virtual void Answer(const std::string& name) {
    const ServingStatus status = service_.StatusOf(name);
    if (status == grpc::health::v1::HealthCheckResponse::SERVICE_UNKNOWN) {
      return call_->Finish(absl::NotFoundError("service: expected one that this server has"));
    }
    Send(status);
    call_->Finish(absl::OkStatus());
  }

  void Send(ServingStatus status) {
    grpc::health::v1::HealthCheckResponse response;
    response.set_status(status);
    call_->Send(response);
  }

  HealthService& service_;
  Call* call_;  // null after the call is over

 private:
  bool received_ = false;
};

// Confined to the thread of its loop, except loop().
class HealthService::WatchCall final : public CheckCall,
                                       public std::enable_shared_from_this<WatchCall> {
 public:
  WatchCall(HealthService* service, Call* call) : CheckCall(service, call), loop_(&call->loop()) {}

  EventLoop& loop() const { return *loop_; }

  // Sends the status if it has changed.
  void Update() {
    if (call_ == nullptr || !watching_) return;
    const ServingStatus status = service_.StatusOf(name_);
    if (status != std::exchange(sent_, status)) Send(status);
  }
  void End() {
    if (call_ != nullptr) call_->Finish(CallGate::DrainingError());
  }

 private:
  void Answer(const std::string& name) override {
    if (std::exchange(watching_, true)) return;
    name_ = name;
    service_.AddWatcher(shared_from_this());
    sent_ = service_.StatusOf(name_);
    Send(sent_);
  }

  EventLoop* const loop_;
  std::string name_;
  bool watching_ = false;
  ServingStatus sent_ = grpc::health::v1::HealthCheckResponse::UNKNOWN;
};

std::shared_ptr<CallHandler> HealthService::Check(Call* call) {
  return std::make_shared<CheckCall>(this, call);
}

std::shared_ptr<CallHandler> HealthService::Watch(Call* call) {
  return std::make_shared<WatchCall>(this, call);
}

HealthService::ServingStatus HealthService::StatusOf(const std::string& service) {
  absl::MutexLock lock(&mutex_);
  const auto found = services_.find(service);
  return found == services_.end() ? grpc::health::v1::HealthCheckResponse::SERVICE_UNKNOWN
                                  : found->second;
}

void HealthService::AddWatcher(const std::shared_ptr<WatchCall>& watcher) {
  absl::MutexLock lock(&mutex_);
  std::erase_if(watchers_, [](const auto& other) { return other.expired(); });
  watchers_.push_back(watcher);
}

std::vector<std::shared_ptr<HealthService::WatchCall>> HealthService::Watchers() {
  absl::MutexLock lock(&mutex_);
  std::vector<std::shared_ptr<WatchCall>> watchers;
  for (const auto& watcher : watchers_) {
    if (auto alive = watcher.lock()) watchers.push_back(std::move(alive));
  }
  return watchers;
}

void HealthService::SetServing(const std::string& service, bool serving) {
  {
    absl::MutexLock lock(&mutex_);
    services_[service] = serving ? grpc::health::v1::HealthCheckResponse::SERVING
                                 : grpc::health::v1::HealthCheckResponse::NOT_SERVING;
  }
  for (auto& watcher : Watchers()) {
    EventLoop& loop = watcher->loop();
    loop.Post([watcher = std::move(watcher)] { watcher->Update(); });
  }
}

void HealthService::EndWatches() {
  for (auto& watcher : Watchers()) {
    EventLoop& loop = watcher->loop();
    loop.Post([watcher = std::move(watcher)] { watcher->End(); });
  }
}

}  // namespace spikeserve
