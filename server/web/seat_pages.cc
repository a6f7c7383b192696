#include <memory>
#include <string>
#include <utility>
#include <variant>

#include "absl/algorithm/container.h"
#include "absl/status/statusor.h"
#include "absl/strings/match.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "proto/json.h"
#include "server/base/method.h"
#include "server/web/call_pages.h"
#include "server/web/status_json.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {
namespace {

template <typename Request>
absl::StatusOr<std::string> ReadJson(HttpRequest* request) {
  ASSIGN_OR_RETURN(const std::string json, TakeBody(request));
  Request message;
  RETURN_IF_ERROR(Annotate(JsonToMessage(json, &message), "body"));
  return message.SerializeAsString();
}

template <typename Response>
std::string WriteJson(const std::string& bytes) {
  Response message;
  message.ParseFromString(bytes);  // our own
  return JsonText(MessageToFields(message));
}

struct SeatPage {
  absl::string_view path;
  const char* method;
  absl::StatusOr<std::string> (*read)(HttpRequest* request);
  std::string (*write)(const std::string& bytes);
};

constexpr SeatPage kSeatPages[] = {
    {"/take.json", "TakeControl", ReadJson<v1::TakeControlRequest>,
     WriteJson<v1::TakeControlResponse>},
    {"/steer.json", "SteerSession", ReadJson<v1::SteerSessionRequest>,
     WriteJson<v1::SteerSessionResponse>},
    {"/return.json", "ReturnControl", ReadJson<v1::ReturnControlRequest>,
     WriteJson<v1::ReturnControlResponse>},
    {"/undo.json", "UndoCorrections", ReadJson<v1::UndoCorrectionsRequest>,
     WriteJson<v1::UndoCorrectionsResponse>}};

// Returns null if there is none at `path`.
const SeatPage* PageAt(absl::string_view path) {
  const auto found =
      absl::c_find_if(kSeatPages, [&](const SeatPage& page) { return page.path == path; });
  return found == std::end(kSeatPages) ? nullptr : found;
}

HttpResponse SeatError(const absl::Status& status, int code) {
  return {.code = code, .content_type = "application/json", .body = ErrorJson(status)};
}

HttpResponse SeatError(const absl::Status& status) {
  return SeatError(status, HttpCode(status.code()));
}

class SeatPages final : public CallPages {
 public:
  explicit SeatPages(HttpCalls* calls) : calls_(*calls) {}

  bool Has(const HttpRequest& request) const override { return PageAt(request.path) != nullptr; }

  std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) const override {
    // No page of another site sends this type without asking first, whatever the browser says of
    // it.
    if (!absl::StartsWith(request.content_type, "application/json")) {
      return SeatError(
          InvalidArgument("Content-Type", "application/json", Quoted(request.content_type)), 415);
    }
    absl::Duration delay;
    auto accepted = calls_.Admit(request, MethodNamed(PageAt(request.path)->method),
                                 LeastBody(request), &delay);
    if (accepted.ok()) return *std::move(accepted);
    HttpResponse refusal = SeatError(accepted.status());
    refusal.delay = delay;
    return refusal;
  }

  void Answer(HttpRequest request, HttpServer::Done done) const override {
    const SeatPage* const page = PageAt(request.path);
    SPIKESERVE_DCHECK(page != nullptr);
    if (!request.is_post) return done(SeatError(InvalidArgument("method", "POST", "GET"), 405));
    calls_.Start(
        {.method = &MethodNamed(page->method), .request = std::move(request), .read = page->read},
        [page, done = std::move(done)](const absl::StatusOr<std::string>& response) {
          if (!response.ok()) return done(SeatError(response.status()));
          done({.content_type = "application/json", .body = page->write(*response)});
        });
  }

 private:
  HttpCalls& calls_;
};

}  // namespace

std::unique_ptr<const CallPages> NewSeatPages(HttpCalls* calls) {
  return std::make_unique<const SeatPages>(calls);
}

}  // namespace spikeserve
