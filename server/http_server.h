// A small HTTP server for pages that a function writes.
//
// Thread-safe.
#ifndef SERVER_HTTP_SERVER_H_
#define SERVER_HTTP_SERVER_H_

#include <functional>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/address.h"

struct mg_context;
struct mg_connection;

namespace spikeserve {

// A GET; a HEAD is answered alike, its body left out.
struct HttpRequest {
  std::string path;   // decoded
  std::string query;  // behind the question mark, as it came
};

struct HttpResponse {
  int code = 200;
  std::string content_type = "text/plain; charset=utf-8";
  std::string body;
};

class HttpServer {
 public:
  // Answers a request; called from many threads.
  using Page = std::function<HttpResponse(const HttpRequest& request)>;

  // Whether the sender of an Authorization header, which may be empty, may see `path`; called from
  // many threads. UNAUTHENTICATED becomes 401, any other error 403.
  using Guard = std::function<absl::Status(absl::string_view path, absl::string_view header)>;

  // UNAVAILABLE if the address cannot be listened on.
  static absl::StatusOr<std::unique_ptr<HttpServer>> Start(const Address& listen, Page page,
                                                           Guard guard);

  // Finishes the answers under way.
  ~HttpServer();
  HttpServer(const HttpServer&) = delete;
  HttpServer& operator=(const HttpServer&) = delete;

  // Where it listens, with the port that was picked.
  const Address& address() const { return address_; }

 private:
  HttpServer(Page page, Guard guard) : page_(std::move(page)), guard_(std::move(guard)) {}

  HttpResponse Answer(const mg_connection* connection, const HttpRequest& request) const;
  static int Handle(mg_connection* connection);
  static int Log(const mg_connection* connection, const char* message);

  const Page page_;
  const Guard guard_;
  std::string start_error_;  // the first thing civetweb said before it was up
  Address address_;
  mg_context* context_ = nullptr;
};

}  // namespace spikeserve

#endif  // SERVER_HTTP_SERVER_H_
