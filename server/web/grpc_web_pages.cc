#include <algorithm>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <variant>

#include "absl/algorithm/container.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "core/base/json.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "server/base/method.h"
#include "server/transport/grpc_wire.h"
#include "server/web/call_pages.h"

namespace spikeserve {
namespace {

constexpr char kTrailerFlag = static_cast<char>(0x80);

// The two forms of the protocol.
enum class Form { kBinary, kText };  // text: everything in base64

// Returns nothing if `content_type` is not that of gRPC-Web with protobuf messages.
std::optional<Form> FormOf(absl::string_view content_type) {
  if (!absl::ConsumePrefix(&content_type, "application/grpc-web")) return std::nullopt;
  const bool is_text = absl::ConsumePrefix(&content_type, "-text");
  absl::ConsumePrefix(&content_type, "+proto");
  if (!content_type.empty() && content_type[0] != ';') return std::nullopt;
  return is_text ? Form::kText : Form::kBinary;
}

// Appends a frame of `bytes` to `out`.
void AppendFrame(char flag, absl::string_view bytes, std::string* out) {
  out->push_back(flag);
  for (int shift = 24; shift >= 0; shift -= 8) {
    out->push_back(static_cast<char>(bytes.size() >> shift));
  }
  absl::StrAppend(out, bytes);
}

// Returns the answer to a call: its status is a last frame of the body, because a page cannot read
// trailers.
HttpResponse ResponseOf(Form form, const absl::StatusOr<std::string>& message) {
  std::string body;
  if (message.ok()) AppendFrame(0, *message, &body);
  const StatusHeaders status = StatusHeadersOf(message.status());
  std::string trailers = absl::StrCat("grpc-status: ", status.code, "\r\n");
  if (!status.message.empty()) absl::StrAppend(&trailers, "grpc-message: ", status.message, "\r\n");
  if (!status.details.empty()) {
    absl::StrAppend(&trailers, "grpc-status-details-bin: ", status.details, "\r\n");
  }
  AppendFrame(kTrailerFlag, trailers, &body);
  if (form == Form::kText) {
    return {.content_type = "application/grpc-web-text+proto", .body = absl::Base64Escape(body)};
  }
  return {.content_type = "application/grpc-web+proto", .body = std::move(body)};
}

// Returns null if `path` is not that of a unary method.
const Method* UnaryMethodAt(absl::string_view path) {
  const auto methods = AllMethods();
  const auto found =
      absl::c_find_if(methods, [&](const Method& method) { return method.path == path; });
  return found == methods.end() || found->streams ? nullptr : &*found;
}

// Returns the length of the body, with its prefix, of a message of `bytes`.
int64_t BodyBytes(Form form, int64_t bytes) {
  const int64_t framed = bytes + int64_t{kMessagePrefixBytes};
  return form == Form::kText ? (framed + 2) / 3 * 4 : framed;
}

// Returns the least length of a message whose body, with its prefix, has `body_bytes`.
int64_t MessageBytes(Form form, int64_t body_bytes) {
  const int64_t bytes = form == Form::kText ? (body_bytes + 3) / 4 * 3 - 2 : body_bytes;
  return std::max<int64_t>(bytes - int64_t{kMessagePrefixBytes}, 0);
}

// Returns the message of a request's body, which is one frame.
absl::StatusOr<std::string> MessageOf(Form form, HttpRequest* request) {
  ASSIGN_OR_RETURN(std::string bytes, TakeBody(request));
  if (form == Form::kText) {
    const std::string text = std::exchange(bytes, {});
    if (!absl::Base64Unescape(text, &bytes)) {
      return absl::InvalidArgumentError("body: expected base64");
    }
  }
  if (bytes.size() < kMessagePrefixBytes) {
    return absl::InvalidArgumentError(absl::StrCat("body: expected one message with a prefix of ",
                                                   kMessagePrefixBytes, " bytes, received ",
                                                   bytes.size(), " bytes"));
  }
  const MessagePrefix prefix = ParseMessagePrefix(bytes);
  if (prefix.compressed) {
    return absl::UnimplementedError("body: expected a message that is not compressed");
  }
  if (bytes.size() != kMessagePrefixBytes + prefix.length) {
    return absl::InvalidArgumentError(absl::StrCat("body: expected one message of ", prefix.length,
                                                   " bytes, received ",
                                                   bytes.size() - kMessagePrefixBytes));
  }
  bytes.erase(0, kMessagePrefixBytes);
  return bytes;
}

class GrpcWebPages final : public CallPages {
 public:
  explicit GrpcWebPages(HttpCalls* calls) : calls_(*calls) {}

  bool Has(const HttpRequest& request) const override {
    return request.is_post && FormOf(request.content_type).has_value();
  }

  std::variant<AcceptedBody, HttpResponse> AcceptBody(const HttpRequest& request) const override {
    const Form form = *FormOf(request.content_type);
    const Method* method = UnaryMethodAt(request.path);
    if (method == nullptr) {
      return ResponseOf(form, absl::UnimplementedError(absl::StrCat(
                                  "path: expected a unary method, because gRPC-Web carries no "
                                  "streams of requests, received ",
                                  Quoted(request.path))));
    }
    absl::Duration delay;
    const int64_t bytes = MessageBytes(form, LeastBody(request));
    auto accepted = calls_.Admit(request, *method, bytes, &delay);
    if (!accepted.ok()) {
      const bool is_too_long =
          absl::IsResourceExhausted(accepted.status()) && bytes > calls_.max_message_bytes();
      HttpResponse refusal =
          is_too_long ? TooLongError(request, BodyBytes(form, calls_.max_message_bytes()))
                      : ResponseOf(form, accepted.status());
      refusal.delay = delay;
      return refusal;
    }
    accepted->longest =
        static_cast<size_t>(BodyBytes(form, static_cast<int64_t>(accepted->longest)));
    return *std::move(accepted);
  }

  void Answer(HttpRequest request, HttpServer::Done done) const override {
    SPIKESERVE_DCHECK(FormOf(request.content_type).has_value());
    const Form form = *FormOf(request.content_type);
    absl::Duration timeout = absl::InfiniteDuration();
    if (!request.grpc_timeout.empty()) {
      const auto parsed = ParseTimeout(request.grpc_timeout);
      if (!parsed.ok()) return done(ResponseOf(form, parsed.status()));
      timeout = *parsed;
    }
    const Method* method = UnaryMethodAt(request.path);
    calls_.Start({.method = method,
                  .request = std::move(request),
                  .read = [form](HttpRequest* body) { return MessageOf(form, body); },
                  .timeout = timeout},
                 [form, done = std::move(done)](const absl::StatusOr<std::string>& response) {
                   done(ResponseOf(form, response));
                 });
  }

 private:
  HttpCalls& calls_;
};

}  // namespace

std::unique_ptr<const CallPages> NewGrpcWebPages(HttpCalls* calls) {
  return std::make_unique<const GrpcWebPages>(calls);
}

}  // namespace spikeserve
