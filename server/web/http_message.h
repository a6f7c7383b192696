// Requests and answers of HTTP/1.1.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "server/access/authenticator.h"
#include "server/base/held_bytes.h"
#include "server/base/peer.h"
#include "server/base/trace_parent.h"

namespace spikeserve {

// A GET, HEAD or POST request. The server leaves out the body of the answer to a HEAD.
struct HttpRequest {
  bool is_post = false;
  std::string path;                                    // decoded
  std::multimap<std::string, std::string> parameters;  // of the query, decoded
  std::string authorization;                           // the header; empty if absent
  TraceParent trace = {};                              // the header traceparent
  Peer peer = {};                                      // the certificate only with a POST
  std::string content_type;                            // the header; empty if absent
  std::string grpc_timeout;                            // the header grpc-timeout
  std::string json_length;  // the header Inference-Header-Content-Length; empty if absent
  int64_t body_length = 0;  // the header Content-Length; 0 if the body comes in chunks
  bool is_gzip = false;     // the body
  std::string body;         // of a POST, as it came
  size_t longest_body = 0;  // once it is decompressed
  std::shared_ptr<const Credential> caller = nullptr;  // of a POST whose body was accepted
  std::shared_ptr<HeldBytes> held = nullptr;           // the bytes of this body
  std::weak_ptr<const void> client = {};               // expires when the client has left
};

// By how much gzip may lengthen what it cannot compress.
inline constexpr int64_t kGzipOverhead = 4096;

// Returns the least length of the decompressed body that `request` announces.
inline int64_t LeastBody(const HttpRequest& request) {
  return std::max<int64_t>(request.body_length - (request.is_gzip ? kGzipOverhead : 0), 0);
}

// A POST whose body is read.
struct AcceptedBody {
  size_t longest = 0;  // bytes, also once it is decompressed
  std::shared_ptr<const Credential> caller;
  std::shared_ptr<HeldBytes> held;
};

// Returns the body of `request`, decompressed, which it moves away. Returns INVALID_ARGUMENT if it
// is not of the format that the client names, RESOURCE_EXHAUSTED if it is too long.
absl::StatusOr<std::string> TakeBody(HttpRequest* request);

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
  std::string headers = "";                     // further ones; each ends in "\r\n"
  std::shared_ptr<HttpFeed> feed = nullptr;     // of what follows `body`; null: nothing
  absl::Duration delay = absl::ZeroDuration();  // before the answer is sent
};

// Returns an answer whose body is {"error": message}.
HttpResponse JsonError(int code, absl::string_view message);

// Returns the answer to a request whose body is longer than the server accepts.
HttpResponse TooLongError(const HttpRequest& request, int64_t most);

// Returns the code of HTTP that shows what `code` does.
int HttpCode(absl::StatusCode code);

// Decodes the target of a request line, such as "/sessions.json?sort=steps", into `path` and
// `parameters`, and returns the host that it names, as "http://localhost:80/healthz" does; empty:
// none. Returns INVALID_ARGUMENT if the target does not begin with a slash or a host, or if a
// percent sign is not followed by two hexadecimal digits.
absl::StatusOr<std::string> DecodeTarget(absl::string_view target, HttpRequest* request);

// Returns the status line and the headers of an answer after which the server closes the
// connection. They allow a page to load only from this server, forbid framing, and disable caching.
// `more_headers`: further ones, as those of the response.
std::string HeadersOf(const HttpResponse& response, absl::string_view more_headers);

}  // namespace spikeserve
