// Answers gRPC-Web, the gRPC of programs in a browser: the unary methods of PolicyService,
// PolicyAdmin and GRPCInferenceService, in the binary form and in base64.
//
// Source: gRPC's public specification, "gRPC-Web" (PROTOCOL-WEB.md).
#ifndef SERVER_WEB_GRPC_WEB_PAGES_H_
#define SERVER_WEB_GRPC_WEB_PAGES_H_

#include <cstddef>
#include <cstdint>
#include <variant>

#include "server/access/authenticator.h"
#include "server/web/http_call.h"
#include "server/web/http_message.h"
#include "server/web/http_server.h"

namespace spikeserve {

// Thread-safe.
class GrpcWebPages {
 public:
  // The pointers must outlive the pages. `max_message_bytes` is the length of the longest request.
  GrpcWebPages(const Authenticator* authenticator, HttpCalls* calls, int64_t max_message_bytes)
      : authenticator_(*authenticator),
        calls_(*calls),
        max_message_bytes_(static_cast<size_t>(max_message_bytes)) {}

  // Returns whether the pages answer the request.
  static bool Has(const HttpRequest& request);

  // See HttpServer::AcceptBody: refuses callers whom the call would refuse.
  std::variant<size_t, HttpResponse> AcceptBody(const HttpRequest& request) const;

  // REQUIRES: AcceptBody() accepted the body of `request`.
  void Answer(const HttpRequest& request, const HttpServer::Done& done) const;

 private:
  const Authenticator& authenticator_;
  HttpCalls& calls_;
  const size_t max_message_bytes_;
};

}  // namespace spikeserve

#endif  // SERVER_WEB_GRPC_WEB_PAGES_H_
