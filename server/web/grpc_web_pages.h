// Answers gRPC-Web, the gRPC of programs in a browser: the unary methods of PolicyService,
// PolicyAdmin and GRPCInferenceService, in the binary form and in base64.
//
// Source: gRPC's public specification, "gRPC-Web" (PROTOCOL-WEB.md).
#pragma once

#include <variant>

#include "server/web/http_call.h"
#include "server/web/http_message.h"
#include "server/web/http_server.h"

namespace spikeserve {

// Thread-safe.
class GrpcWebPages {
 public:
  // `calls` must outlive the pages.
  explicit GrpcWebPages(HttpCalls* calls) : calls_(*calls) {}

  // Returns whether the pages answer the request.
  static bool Has(const HttpRequest& request);

  // See AcceptHttpBody.
  std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) const;

  // REQUIRES: AcceptBody() accepted the body of `request`.
  void Answer(HttpRequest request, HttpServer::Done done) const;

 private:
  HttpCalls& calls_;
};

}  // namespace spikeserve
