// Answers the Open Inference Protocol over HTTP: GET /v2, /v2/health/live, /v2/health/ready,
// /v2/models/NAME[/versions/V][/ready], and POST /v2/models/NAME[/versions/V]/infer. Each request
// becomes a call of GRPCInferenceService.
#pragma once

#include <variant>

#include "absl/strings/string_view.h"
#include "server/web/http_call.h"
#include "server/web/http_message.h"
#include "server/web/http_server.h"

namespace spikeserve {

// Thread-safe.
class InferencePages {
 public:
  // `calls` must outlive the pages.
  explicit InferencePages(HttpCalls* calls) : calls_(*calls) {}

  // Returns whether the pages answer requests for `path`.
  static bool Has(absl::string_view path);

  // See AcceptHttpBody.
  std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) const;

  void Answer(HttpRequest request, HttpServer::Done done) const;

 private:
  HttpCalls& calls_;
};

}  // namespace spikeserve
