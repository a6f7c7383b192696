// A small HTTP or HTTPS server on an event loop of its own. One function answers all requests.
//
//   auto server = HttpServer::Start({.listen = address, .clock = &clock},
//                                   [](const HttpRequest& request, HttpServer::Done done) {
//                                     done({.body = "hello\n"});
//                                   });
//
// A client that is slow, or that holds many connections, delays no other: nothing waits for it, and
// above 200 connections whose request is incomplete each new one closes the oldest of the network
// that has most of them.
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <thread>
#include <variant>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "server/base/address.h"
#include "server/base/file_descriptor.h"
#include "server/transport/acceptor.h"
#include "server/transport/connection_host.h"
#include "server/transport/connection_table.h"
#include "server/transport/event_loop.h"
#include "server/transport/unauthenticated_queue.h"
#include "server/web/http_connection.h"

namespace spikeserve {

class HttpServer final : public ConnectionHost, public HttpConnection::Owner {
 public:
  // Takes the answer to a request. May be called from any thread, once, also after the server has
  // been destroyed.
  using Done = std::function<void(HttpResponse response)>;
  // Answers a request. Called on the loop's thread: work that takes long belongs on another.
  using Page = std::function<void(HttpRequest request, Done done)>;

  // Returns UNAVAILABLE if it cannot listen on the address.
  static absl::StatusOr<std::unique_ptr<HttpServer>> Start(const HttpOptions& options, Page page);

  // Accepts no more connections, gives those that are open a second to end, and stops.
  ~HttpServer();
  HttpServer(const HttpServer&) = delete;
  HttpServer& operator=(const HttpServer&) = delete;

  // The address that the server listens on, with the actual port.
  const Address& address() const { return address_; }

 private:
  HttpServer(Address address, std::unique_ptr<EventLoop> events, const HttpOptions& options,
             Page page);

  // Starts accepting from the listening sockets, and the thread.
  absl::Status Run(std::vector<FileDescriptor> listeners);

  // ConnectionHost. On the loop's thread, except CloseSoon().
  EventLoop& events() override { return *events_; }
  UnauthenticatedQueue& unauthenticated_queue() override { return unauthenticated_queue_; }
  void Adopt(std::unique_ptr<Socket> socket, std::unique_ptr<ConnectionSlot> slot) override;
  void CloseSoon(uint64_t number) override;

  // HttpConnection::Owner
  std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) override;
  void OnRequest(HttpConnection* connection, HttpRequest request) override;
  void OnClosed(HttpConnection* connection) override;

  void Answer(uint64_t number, HttpResponse response);

  const Address address_;
  // Shared with the answers that are being computed, which may outlive the server.
  const std::shared_ptr<EventLoop> events_;
  const HttpOptions options_;
  const Page page_;
  UnauthenticatedQueue unauthenticated_queue_;
  ConnectionTable table_;
  std::map<uint64_t, std::unique_ptr<HttpConnection>> connections_;  // by their numbers
  std::vector<std::unique_ptr<Acceptor>> acceptors_;
  std::thread thread_;
};

}  // namespace spikeserve
