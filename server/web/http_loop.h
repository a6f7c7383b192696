// The loop of an HttpServer, its thread and its connections.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <thread>
#include <variant>
#include <vector>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/access/tls_context.h"
#include "server/base/file_descriptor.h"
#include "server/transport/acceptor.h"
#include "server/transport/connection_host.h"
#include "server/transport/connection_table.h"
#include "server/transport/event_loop.h"
#include "server/transport/unauthenticated_queue.h"
#include "server/web/http_connection.h"
#include "server/web/http_server.h"

namespace spikeserve {

// Thread-safety: Run() and Stop() are called by the thread that creates the loop, CloseSoon() by
// any, everything else by the loop's own thread.
class HttpLoop final : public ConnectionHost, public HttpConnection::Owner {
 public:
  HttpLoop(std::unique_ptr<EventLoop> events, const HttpServer::Options& options,
           HttpServer::Page page);
  ~HttpLoop();
  HttpLoop(const HttpLoop&) = delete;
  HttpLoop& operator=(const HttpLoop&) = delete;

  // Starts accepting from the listening sockets, and the thread.
  absl::Status Run(std::vector<FileDescriptor> listeners);
  // Accepts no more, gives the connections `timeout` to end, and ends the thread.
  void Stop(absl::Duration timeout);

  // ConnectionHost
  EventLoop& events() override { return *events_; }
  UnauthenticatedQueue& unauthenticated_queue() override { return unauthenticated_queue_; }
  void Adopt(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot) override;
  void CloseSoon(uint64_t number) override;

  // HttpConnection::Owner
  std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) override;
  void OnRequest(HttpConnection* connection, HttpRequest request) override;
  void OnClosed(HttpConnection* connection) override;

 private:
  void Answer(uint64_t number, HttpResponse response);

  // Shared with the answers that are being computed, which may outlive the server.
  const std::shared_ptr<EventLoop> events_;
  const HttpServer::Options options_;
  const HttpServer::Page page_;
  UnauthenticatedQueue unauthenticated_queue_;
  ConnectionTable table_;
  std::map<uint64_t, std::unique_ptr<HttpConnection>> connections_;  // by their numbers
  std::vector<std::unique_ptr<Acceptor>> acceptors_;
  std::thread thread_;
};

}  // namespace spikeserve
