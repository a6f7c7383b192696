// A small HTTP or HTTPS server. One function answers all requests.
//
//   auto server = HttpServer::Start(address, tls, [](const HttpRequest& request) {
//     return HttpResponse{.body = "hello\n"};
//   });
//
// Thread-safe.
#ifndef SERVER_WEB_HTTP_SERVER_H_
#define SERVER_WEB_HTTP_SERVER_H_

#include <functional>
#include <map>
#include <memory>
#include <string>
#include <thread>

#include "absl/status/statusor.h"
#include "server/access/tls.h"
#include "server/base/address.h"

namespace httplib {
class Server;
}  // namespace httplib

namespace spikeserve {

// A GET or HEAD request. The server leaves out the body of the answer to a HEAD.
struct HttpRequest {
  std::string path;                                    // decoded
  std::multimap<std::string, std::string> parameters;  // of the query, decoded
  std::string authorization;                           // the header; empty if absent
};

struct HttpResponse {
  int code = 200;  // with 401 the server asks for HTTP Basic authentication
  std::string content_type = "text/plain; charset=utf-8";
  std::string body;
};

class HttpServer {
 public:
  // Answers a request. Called from several threads at once.
  using Page = std::function<HttpResponse(const HttpRequest& request)>;

  // Starts a server on `listen`, with TLS if `tls` is enabled. `local_names_only`: answers 403
  // unless the header Host names this machine, as localhost or a loopback address. Returns
  // UNAVAILABLE if it cannot listen on the address. REQUIRES: MakeServerCredentials(tls) succeeded.
  static absl::StatusOr<std::unique_ptr<HttpServer>> Start(const Address& listen,
                                                           const TlsFiles& tls,
                                                           bool local_names_only, Page page);

  // Stops the server. Blocks until the requests that are being answered have been answered.
  ~HttpServer();
  HttpServer(const HttpServer&) = delete;
  HttpServer& operator=(const HttpServer&) = delete;

  // The address that the server listens on, with the actual port.
  const Address& address() const { return address_; }

 private:
  HttpServer(const TlsFiles& tls, bool local_names_only, Page page);

  const TlsFiles tls_;
  const bool local_names_only_;
  const Page page_;
  const std::unique_ptr<httplib::Server> server_;
  Address address_;
  std::thread listener_;
};

}  // namespace spikeserve

#endif  // SERVER_WEB_HTTP_SERVER_H_
