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

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <variant>

#include "absl/status/statusor.h"
#include "core/base/clock.h"
#include "server/access/tls_context.h"
#include "server/base/address.h"
#include "server/web/http_message.h"
#include "server/web/origins.h"

namespace spikeserve {

class HttpLoop;

class HttpServer {
 public:
  // Takes the answer to a request. May be called from any thread, once, also after the server has
  // been destroyed.
  using Done = std::function<void(HttpResponse response)>;
  // Answers a request. Called on the loop's thread: work that takes long belongs on another.
  using Page = std::function<void(HttpRequest request, Done done)>;
  // Admits the caller of a POST before any of its body is read, or returns the answer to a POST
  // that is refused. Called on the loop's thread.
  using AcceptBody =
      std::function<std::variant<AcceptedBody, HttpResponse>(const HttpRequest& request)>;

  struct Options {
    Address listen;
    TlsContext* tls = nullptr;      // null: plain text; must outlive the server
    bool local_names_only = false;  // answers 403 unless the header Host names this machine
    Origins origins = {};           // whose pages may send a POST, and read answers
    const Clock* clock = nullptr;   // monotonic; must outlive the server
    AcceptBody accept_body = {};    // empty: every POST is answered with 405
  };

  // Returns UNAVAILABLE if it cannot listen on the address.
  static absl::StatusOr<std::unique_ptr<HttpServer>> Start(const Options& options, Page page);

  // Accepts no more connections, gives those that are open a second to end, and stops.
  ~HttpServer();
  HttpServer(const HttpServer&) = delete;
  HttpServer& operator=(const HttpServer&) = delete;

  // The address that the server listens on, with the actual port.
  const Address& address() const { return address_; }

 private:
  HttpServer(Address address, std::unique_ptr<HttpLoop> loop);

  const Address address_;
  const std::unique_ptr<HttpLoop> loop_;
};

}  // namespace spikeserve
