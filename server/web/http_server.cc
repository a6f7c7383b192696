#include "server/web/http_server.h"

#include <pthread.h>

#include <utility>

#include "absl/time/clock.h"
#include "core/base/status_macros.h"
#include "server/transport/listener.h"

namespace spikeserve {
namespace {

// All are unauthenticated, so three quarters of these may be open; see ConnectionTable.
constexpr int64_t kMaxConnections = 320;
constexpr int64_t kMaxWaiting = 200;  // connections whose request is incomplete

constexpr absl::Duration kStopTimeout = absl::Seconds(1);
constexpr absl::Duration kStopPollInterval = absl::Milliseconds(5);

constexpr absl::string_view kRefusal =
    "HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";

}  // namespace

absl::StatusOr<std::unique_ptr<HttpServer>> HttpServer::Start(const HttpOptions& options,
                                                              Page page) {
  ASSIGN_OR_RETURN(auto listeners, Listen("--http_listen", options.listen));
  ASSIGN_OR_RETURN(auto events, EventLoop::Create(options.clock));
  auto server = std::unique_ptr<HttpServer>(
      new HttpServer(listeners.address, std::move(events), options, std::move(page)));
  RETURN_IF_ERROR(server->Run(std::move(listeners.sockets)));
  return server;
}

HttpServer::HttpServer(Address address, std::unique_ptr<EventLoop> events,
                       const HttpOptions& options, Page page)
    : address_(std::move(address)),
      events_(std::move(events)),
      options_(options),
      page_(std::move(page)),
      unauthenticated_queue_(events_.get(), options.clock),
      table_({.connections = kMaxConnections,
              .per_address = kMaxConnections,
              .per_network = kMaxConnections,
              .idle_unauthenticated = kMaxWaiting}) {}

absl::Status HttpServer::Run(std::vector<FileDescriptor> listeners) {
  const Acceptor::Options accepting = {
      .hosts = {this}, .connections = &table_, .refusal = kRefusal, .tls = options_.tls};
  for (FileDescriptor& listener : listeners) {
    acceptors_.push_back(std::make_unique<Acceptor>(std::move(listener), accepting));
    RETURN_IF_ERROR(acceptors_.back()->Start());
  }
  thread_ = std::thread([this] {
    pthread_setname_np(pthread_self(), "http");  // for those who look at the threads of the process
    events_->Run();
  });
  return absl::OkStatus();
}

HttpServer::~HttpServer() {
  if (!thread_.joinable()) return;
  events_->Post([this] {
    for (const auto& acceptor : acceptors_) acceptor->Stop();
    for (const auto& [number, connection] : connections_) connection->EndFeed();
  });
  const absl::Duration end = options_.clock->Now() + kStopTimeout;
  while (table_.counts().open > 0 && options_.clock->Now() < end) {
    absl::SleepFor(kStopPollInterval);
  }
  events_->Stop();
  thread_.join();
  while (!connections_.empty()) connections_.begin()->second->Close();
  // A page that is still being made keeps the loop of events, but the connections need `table_`.
  events_->DeleteRest();
}

void HttpServer::Adopt(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot) {
  auto connection =
      std::make_unique<HttpConnection>(std::move(socket), std::move(slot), options_, this);
  HttpConnection& started = *connection;
  connections_.emplace(started.number(), std::move(connection));
  if (!started.Start().ok()) started.Close();
}

void HttpServer::CloseSoon(uint64_t number) {
  events_->Post([this, number] {
    const auto found = connections_.find(number);
    if (found != connections_.end()) found->second->Close();
  });
}

std::variant<AcceptedBody, HttpResponse> HttpServer::AcceptBody(const HttpRequest& request) {
  if (options_.accept_body != nullptr) return options_.accept_body(request);
  return HttpResponse{.code = 405, .body = "expected GET or HEAD\n"};
}

void HttpServer::OnRequest(HttpConnection* connection, HttpRequest request) {
  const uint64_t number = connection->number();
  // What is posted after the loop has stopped does not run, so `this` is alive when it is used.
  page_(std::move(request), [this, events = events_, number](HttpResponse response) {
    events->Post([this, number, response = std::move(response)]() mutable {
      Answer(number, std::move(response));
    });
  });
}

void HttpServer::Answer(uint64_t number, HttpResponse response) {
  const auto found = connections_.find(number);
  if (found != connections_.end()) found->second->Answer(std::move(response));
}

void HttpServer::OnClosed(HttpConnection* connection) {
  auto node = connections_.extract(connection->number());
  events_->DeleteLater(std::move(node.mapped()));
}

}  // namespace spikeserve
