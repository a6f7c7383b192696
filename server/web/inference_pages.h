// Answers the Open Inference Protocol over HTTP: GET /v2, /v2/health/live, /v2/health/ready,
// /v2/models/NAME[/versions/V][/ready], and POST /v2/models/NAME[/versions/V]/infer. Each request
// becomes a call of GRPCInferenceService.
#ifndef SERVER_WEB_INFERENCE_PAGES_H_
#define SERVER_WEB_INFERENCE_PAGES_H_

#include <cstddef>
#include <cstdint>
#include <string>
#include <variant>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/access/authenticator.h"
#include "server/base/method.h"
#include "server/web/http_call.h"
#include "server/web/http_message.h"
#include "server/web/http_server.h"

namespace spikeserve {

// Thread-safe.
class InferencePages {
 public:
  // The pointers must outlive the pages. `max_message_bytes` is the length of the longest body.
  InferencePages(const Authenticator* authenticator, HttpCalls* calls, int64_t max_message_bytes)
      : authenticator_(*authenticator),
        calls_(*calls),
        max_message_bytes_(static_cast<size_t>(max_message_bytes)) {}

  // Returns whether the pages answer requests for `path`.
  static bool Has(absl::string_view path);

  // See HttpServer::AcceptBody: refuses callers whom the call would refuse.
  std::variant<size_t, HttpResponse> AcceptBody(const HttpRequest& request) const;

  void Answer(const HttpRequest& request, const HttpServer::Done& done) const;

 private:
  const Authenticator& authenticator_;
  HttpCalls& calls_;
  const size_t max_message_bytes_;
};

}  // namespace spikeserve

#endif  // SERVER_WEB_INFERENCE_PAGES_H_
