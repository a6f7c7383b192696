#include "server/web/http_loop.h"

#include <utility>

#include "absl/time/clock.h"

namespace spikeserve {
namespace {

constexpr int64_t kMaxConnections = 240;
constexpr int64_t kMaxWaiting = 200;  // connections that wait for their clients

constexpr absl::Duration kStopPollInterval = absl::Milliseconds(5);

constexpr absl::string_view kRefusal =
    "HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";

}  // namespace

HttpLoop::HttpLoop(std::unique_ptr<EventLoop> events, const HttpServer::Options& options,
                   HttpServer::Page page)
    : events_(std::move(events)),
      options_(options),
      page_(std::move(page)),
      stranger_queue_(events_.get(), options.clock),
      table_(kMaxConnections, kMaxConnections) {}

HttpLoop::~HttpLoop() { Stop(absl::ZeroDuration()); }

absl::Status HttpLoop::Run(std::vector<FileDescriptor> listeners) {
  const Acceptor::Options accepting = {.hosts = {this},
                                       .connections = &table_,
                                       .max_strangers = kMaxWaiting,
                                       .refusal = kRefusal,
                                       .tls = options_.tls};
  for (FileDescriptor& listener : listeners) {
    acceptors_.push_back(std::make_unique<Acceptor>(std::move(listener), accepting));
    if (auto status = acceptors_.back()->Start(); !status.ok()) return status;
  }
  thread_ = std::thread([this] { events_->Run(); });
  return absl::OkStatus();
}

void HttpLoop::Stop(absl::Duration timeout) {
  if (!thread_.joinable()) return;
  events_->Post([this] {
    for (const auto& acceptor : acceptors_) acceptor->Stop();
  });
  const absl::Duration end = options_.clock->Now() + timeout;
  while (table_.connections() > 0 && options_.clock->Now() < end) {
    absl::SleepFor(kStopPollInterval);
  }
  events_->Stop();
  thread_.join();
  while (!connections_.empty()) connections_.begin()->second->Close();
  // A page that is still being made keeps the loop of events, but the connections need `table_`.
  events_->DeleteRest();
}

void HttpLoop::Adopt(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot) {
  const uint64_t id = next_id_++;
  auto connection = std::make_unique<HttpConnection>(std::move(socket), std::move(slot), id,
                                                     options_.local_names_only, this);
  HttpConnection& started = *connection;
  connections_.emplace(id, std::move(connection));
  if (!started.Start().ok()) started.Close();
}

void HttpLoop::CloseOldestStranger() {
  for (const auto& [id, connection] : connections_) {
    if (!connection->is_being_answered()) return connection->Close();
  }
}

void HttpLoop::OnRequest(HttpConnection* connection, HttpRequest request) {
  const uint64_t id = connection->id();
  // What is posted after the loop has stopped does not run, so `this` is alive when it is used.
  page_(request, [this, events = events_, id](const HttpResponse& response) {
    events->Post([this, id, response] { Answer(id, response); });
  });
}

void HttpLoop::Answer(uint64_t id, const HttpResponse& response) {
  const auto found = connections_.find(id);
  if (found != connections_.end()) found->second->Answer(response);
}

void HttpLoop::OnClosed(HttpConnection* connection) {
  auto node = connections_.extract(connection->id());
  events_->DeleteLater(std::move(node.mapped()));
}

}  // namespace spikeserve
