#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "inference/grpc_service.pb.h"
#include "nlohmann/json.hpp"
#include "server/inference/inference_json.h"
#include "server/web/call_pages.h"

namespace spikeserve {
namespace {

constexpr char kPaths[] =
    "/v2, /v2/health/live, /v2/health/ready, or /v2/models/NAME[/versions/V], which /ready or "
    "/infer may follow";

enum class Page { kServer, kLive, kReady, kModel, kModelReady, kInfer };

// What a path names.
struct PageRoute {
  Page page = Page::kServer;
  std::string model = "";
  std::string version = "";  // empty: the default
};

// Returns nothing if `path` names nothing.
std::optional<PageRoute> RouteOf(absl::string_view path) {
  std::vector<std::string> parts = absl::StrSplit(path, '/');  // of "/v2/x": "", "v2", "x"
  if (parts.size() == 3 && parts.back().empty()) parts.pop_back();
  if (parts.size() == 2) return PageRoute{};
  if (parts[2] == "health" && parts.size() == 4) {
    if (parts[3] == "live") return PageRoute{.page = Page::kLive};
    if (parts[3] == "ready") return PageRoute{.page = Page::kReady};
  }
  if (parts[2] != "models" || parts.size() < 4 || parts[3].empty()) return std::nullopt;
  PageRoute route = {.page = Page::kModel, .model = parts[3]};
  size_t next = 4;
  if (parts.size() >= 6 && parts[4] == "versions" && !parts[5].empty()) {
    route.version = parts[5];
    next = 6;
  }
  if (parts.size() == next) return route;
  if (parts.size() != next + 1) return std::nullopt;
  if (parts[next] == "ready") {
    route.page = Page::kModelReady;
  } else if (parts[next] == "infer") {
    route.page = Page::kInfer;
  } else {
    return std::nullopt;
  }
  return route;
}

// Returns the method that answers the page.
const Method& MethodOfPage(const PageRoute& route) {
  switch (route.page) {
    case Page::kServer:
      return MethodNamed("ServerMetadata");
    case Page::kLive:
      return MethodNamed("ServerLive");
    case Page::kReady:
      return MethodNamed("ServerReady");
    case Page::kModel:
      return MethodNamed("ModelMetadata");
    case Page::kModelReady:
      return MethodNamed("ModelReady");
    case Page::kInfer:
      break;
  }
  return MethodNamed("ModelInfer");
}

HttpResponse JsonResponse(int code, std::string body) {
  return {.code = code, .content_type = "application/json", .body = std::move(body)};
}

HttpResponse ErrorResponse(const absl::Status& status,
                           absl::Duration delay = absl::ZeroDuration()) {
  HttpResponse response = JsonError(HttpCode(status.code()), status.message());
  response.delay = delay;
  return response;
}

HttpResponse UnknownPath() { return JsonError(404, absl::StrCat("path: expected ", kPaths)); }

// Returns the serialized message of a request without a body.
std::string MessageOf(const PageRoute& route) {
  switch (route.page) {
    case Page::kModelReady: {
      inference::ModelReadyRequest message;
      message.set_name(route.model);
      message.set_version(route.version);
      return message.SerializeAsString();
    }
    case Page::kModel: {
      inference::ModelMetadataRequest message;
      message.set_name(route.model);
      message.set_version(route.version);
      return message.SerializeAsString();
    }
    default:  // the others are empty
      return "";
  }
}

absl::StatusOr<HttpInferRequest> ReadInfer(HttpRequest* request, const PageRoute& route) {
  std::optional<size_t> json_bytes;
  if (!request->json_length.empty() &&
      !absl::SimpleAtoi(request->json_length, &json_bytes.emplace())) {
    return absl::InvalidArgumentError(
        absl::StrCat("Inference-Header-Content-Length: expected a "
                     "length in bytes, received ",
                     Quoted(request->json_length)));
  }
  const auto body = TakeBody(request);
  if (!body.ok()) return Annotate(body.status(), "body");
  auto infer = ReadHttpInfer(*body, json_bytes);
  if (!infer.ok()) return infer;
  infer->message.set_model_name(route.model);
  infer->message.set_model_version(route.version);
  return infer;
}

template <typename Message>
Message Parse(const std::string& bytes) {
  Message message;
  message.ParseFromString(bytes);  // our own
  return message;
}

HttpResponse InferResponse(const std::string& bytes, const BinaryOutputs& outputs) {
  auto written = WriteHttpInfer(Parse<inference::ModelInferResponse>(bytes), outputs);
  HttpResponse response = JsonResponse(200, std::move(written.body));
  if (written.json_bytes.has_value()) {
    response.content_type = "application/octet-stream";
    response.headers =
        absl::StrCat("Inference-Header-Content-Length: ", *written.json_bytes, "\r\n");
  }
  return response;
}

// Returns the answer to a request without a body.
HttpResponse ResponseOf(const PageRoute& route, const std::string& bytes) {
  using Json = nlohmann::ordered_json;
  switch (route.page) {
    case Page::kLive: {
      const bool live = Parse<inference::ServerLiveResponse>(bytes).live();
      return JsonResponse(live ? 200 : 503, Json{{"live", live}}.dump());
    }
    case Page::kReady: {
      const bool ready = Parse<inference::ServerReadyResponse>(bytes).ready();
      return JsonResponse(ready ? 200 : 503, Json{{"ready", ready}}.dump());
    }
    case Page::kModelReady: {
      const bool ready = Parse<inference::ModelReadyResponse>(bytes).ready();
      const Json json = {{"name", route.model}, {"ready", ready}};
      return JsonResponse(ready ? 200 : 404,
                          json.dump(-1, ' ', false, Json::error_handler_t::replace));
    }
    case Page::kModel:
      return JsonResponse(200, ToHttpBody(Parse<inference::ModelMetadataResponse>(bytes)));
    default:
      return JsonResponse(200, ToHttpBody(Parse<inference::ServerMetadataResponse>(bytes)));
  }
}

void Infer(HttpCalls& calls, const PageRoute& route, HttpRequest request, HttpServer::Done done) {
  // What is known of the answer once a worker has read the body, before the call begins.
  struct Plan {
    BinaryOutputs outputs;
    bool is_too_long = false;  // the body
  };
  const auto plan = std::make_shared<Plan>();
  calls.Start({.method = &MethodOfPage(route),
               .request = std::move(request),
               .read = [route, plan](HttpRequest* body) -> absl::StatusOr<std::string> {
                 auto infer = ReadInfer(body, route);
                 plan->is_too_long = absl::IsResourceExhausted(infer.status());
                 if (!infer.ok()) return infer.status();
                 plan->outputs = std::move(infer->outputs);
                 return infer->message.SerializeAsString();
               }},
              [plan, done = std::move(done)](const absl::StatusOr<std::string>& response) {
                if (response.ok()) return done(InferResponse(*response, plan->outputs));
                HttpResponse error = ErrorResponse(response.status());
                if (plan->is_too_long) error.code = 413;
                done(std::move(error));
              });
}

class InferencePages final : public CallPages {
 public:
  explicit InferencePages(HttpCalls* calls) : calls_(*calls) {}

  bool Has(const HttpRequest& request) const override {
    return request.path == "/v2" || absl::StartsWith(request.path, "/v2/");
  }

  std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) const override {
    const auto route = RouteOf(request.path);
    if (!route.has_value()) return UnknownPath();
    if (route->page != Page::kInfer) {
      return JsonError(405, "method: expected GET");
    }
    absl::Duration delay;
    auto accepted = calls_.Admit(request, MethodOfPage(*route), LeastBody(request), &delay);
    if (accepted.ok()) return *std::move(accepted);
    if (!absl::IsResourceExhausted(accepted.status()) ||
        LeastBody(request) <= calls_.max_message_bytes()) {
      return ErrorResponse(accepted.status(), delay);
    }
    HttpResponse refusal = TooLongError(request, calls_.max_message_bytes());
    refusal.delay = delay;
    return refusal;
  }

  void Answer(HttpRequest request, HttpServer::Done done) const override {
    const auto route = RouteOf(request.path);
    if (!route.has_value()) return done(UnknownPath());
    const bool infers = route->page == Page::kInfer;
    if (infers != request.is_post) {
      return done(JsonError(405, "method: expected POST"));
    }
    if (infers) return Infer(calls_, *route, std::move(request), std::move(done));
    const Method* const method = &MethodOfPage(*route);
    absl::Duration delay;
    const auto admitted = calls_.Admit(request, *method, /*message_bytes=*/0, &delay);
    if (!admitted.ok()) return done(ErrorResponse(admitted.status(), delay));
    request.caller = admitted->caller;
    calls_.Start(
        {.method = method,
         .request = std::move(request),
         .read = [route = *route](HttpRequest* /*request*/) { return MessageOf(route); }},
        [route = *route, done = std::move(done)](const absl::StatusOr<std::string>& response) {
          done(response.ok() ? ResponseOf(route, *response) : ErrorResponse(response.status()));
        });
  }

 private:
  HttpCalls& calls_;
};

}  // namespace

std::unique_ptr<const CallPages> NewInferencePages(HttpCalls* calls) {
  return std::make_unique<const InferencePages>(calls);
}

}  // namespace spikeserve
