// A small HTTP or HTTPS server for pages that a function writes.
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

// A GET; a HEAD is answered alike, its body left out.
struct HttpRequest {
  std::string path;                                    // decoded
  std::multimap<std::string, std::string> parameters;  // behind the question mark, decoded
  std::string authorization;                           // the header, empty where none came
};

struct HttpResponse {
  int code = 200;  // 401 makes a browser ask for name and password
  std::string content_type = "text/plain; charset=utf-8";
  std::string body;
};

class HttpServer {
 public:
  // Answers a request; called from many threads.
  using Page = std::function<HttpResponse(const HttpRequest& request)>;

  // Speaks TLS where `tls` is enabled, whose files must have been found good. UNAVAILABLE if the
  // address cannot be listened on.
  static absl::StatusOr<std::unique_ptr<HttpServer>> Start(const Address& listen,
                                                           const TlsFiles& tls, Page page);

  // Finishes the answers under way.
  ~HttpServer();
  HttpServer(const HttpServer&) = delete;
  HttpServer& operator=(const HttpServer&) = delete;

  // Where it listens, with the port that was picked.
  const Address& address() const { return address_; }

 private:
  HttpServer(const TlsFiles& tls, Page page);

  const TlsFiles tls_;
  const Page page_;
  const std::unique_ptr<httplib::Server> server_;
  Address address_;
  std::thread listener_;
};

}  // namespace spikeserve

#endif  // SERVER_WEB_HTTP_SERVER_H_
