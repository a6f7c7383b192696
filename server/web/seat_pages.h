// Answers the status page's seat of an operator: POST /take.json, /steer.json, /return.json and
// /undo.json, the methods TakeControl, SteerSession, ReturnControl and UndoCorrections with their
// messages as JSON. They are calls like those of gRPC: with the same rights, rates, audit and
// confirmations by the store.
#pragma once

#include <variant>

#include "absl/strings/string_view.h"
#include "server/web/http_call.h"
#include "server/web/http_message.h"
#include "server/web/http_server.h"

namespace spikeserve {

// Thread-safe.
class SeatPages {
 public:
  // `calls` must outlive the pages.
  explicit SeatPages(HttpCalls* calls) : calls_(*calls) {}

  // Returns whether the pages answer requests for `path`.
  static bool Has(absl::string_view path);

  // See AcceptHttpBody.
  std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) const;

  // An error is answered with {"code", "message"}; 405 without a POST.
  void Answer(HttpRequest request, HttpServer::Done done) const;

 private:
  HttpCalls& calls_;
};

}  // namespace spikeserve
