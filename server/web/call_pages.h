// Pages of the HTTP port whose requests become calls like those of gRPC: with the same rights,
// rates, audit and confirmations by the store.
#pragma once

#include <memory>
#include <variant>

#include "server/web/http_call.h"
#include "server/web/http_message.h"
#include "server/web/http_server.h"

namespace spikeserve {

// Thread-safe.
class CallPages {
 public:
  virtual ~CallPages() = default;

  // Returns whether the pages answer the request. The other methods REQUIRE it.
  virtual bool Has(const HttpRequest& request) const = 0;
  // See AcceptHttpBody.
  virtual std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) const = 0;
  // REQUIRES: AcceptBody() accepted the body of a POST.
  virtual void Answer(HttpRequest request, HttpServer::Done done) const = 0;
};

// `calls` must outlive the pages.

// The status page's seat of an operator: POST /take.json, /steer.json, /return.json and /undo.json,
// the methods TakeControl, SteerSession, ReturnControl and UndoCorrections with their messages as
// JSON. An error is answered with {"code", "message"}; 405 without a POST.
std::unique_ptr<const CallPages> NewSeatPages(HttpCalls* calls);

// gRPC-Web, the gRPC of programs in a browser: the unary methods of PolicyService, PolicyAdmin and
// GRPCInferenceService, in the binary form and in base64.
//
// Source: gRPC's public specification, "gRPC-Web" (PROTOCOL-WEB.md).
std::unique_ptr<const CallPages> NewGrpcWebPages(HttpCalls* calls);

// The Open Inference Protocol over HTTP: GET /v2, /v2/health/live, /v2/health/ready,
// /v2/models/NAME[/versions/V][/ready], and POST /v2/models/NAME[/versions/V]/infer. Each request
// becomes a call of GRPCInferenceService.
std::unique_ptr<const CallPages> NewInferencePages(HttpCalls* calls);

}  // namespace spikeserve
