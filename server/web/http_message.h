// Requests and answers of HTTP/1.1.
#ifndef SERVER_WEB_HTTP_MESSAGE_H_
#define SERVER_WEB_HTTP_MESSAGE_H_

#include <map>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "server/base/trace_parent.h"

namespace spikeserve {

// A GET, HEAD or POST request. The server leaves out the body of the answer to a HEAD.
struct HttpRequest {
  bool is_post = false;
  std::string path;                                    // decoded
  std::multimap<std::string, std::string> parameters;  // of the query, decoded
  std::string authorization;                           // the header; empty if absent
  TraceParent trace = {};                              // the header traceparent
  std::string client;                                  // IP address
  std::string content_type;                            // the header; empty if absent
  std::string grpc_timeout;                            // the header grpc-timeout
  std::string json_length;  // the header Inference-Header-Content-Length; empty if absent
  std::string body;         // of a POST, decompressed
};

// The rest of a body that goes on for as long as the client listens, such as events.
class HttpFeed {
 public:
  virtual ~HttpFeed() = default;
  // Returns the next bytes, which may be none, or nullopt at the end of the body. Called on the
  // thread of the server's loop about every 50 ms, and only after the client has taken all bytes
  // before, so that a slow client makes no queue. Must not block.
  virtual std::optional<std::string> Next() = 0;
};

struct HttpResponse {
  int code = 200;  // with 401 the server asks for HTTP Basic authentication
  std::string content_type = "text/plain; charset=utf-8";
  std::string body;
  std::string headers = "";                  // further ones; each ends in "\r\n"
  std::shared_ptr<HttpFeed> feed = nullptr;  // of what follows `body`; null: nothing
};

// Returns the code of HTTP that shows what `code` does.
int HttpCode(absl::StatusCode code);

// Decodes the target of a request line, such as "/sessions.json?sort=steps", into `path` and
// `parameters`. Returns INVALID_ARGUMENT if the target does not begin with a slash, or if a percent
// sign is not followed by two hexadecimal digits.
absl::Status DecodeTarget(absl::string_view target, HttpRequest* request);

// Returns the bytes of an answer after which the server closes the connection. Its headers allow a
// page to load only from this server, forbid framing, and disable caching. `more_headers`: further
// ones, as those of the response.
std::string ToBytes(const HttpResponse& response, bool with_body, absl::string_view more_headers);

}  // namespace spikeserve

#endif  // SERVER_WEB_HTTP_MESSAGE_H_
