#include "server/web/http_message.h"

#include <algorithm>
#include <boost/beast/http/status.hpp>
#include <optional>
#include <utility>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "server/base/gzip.h"
#include "server/base/http_query.h"
#include "server/inference/inference_json.h"

namespace spikeserve {
namespace {

constexpr absl::string_view kPageHeaders =
    "Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; connect-src "
    "'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n"
    "X-Content-Type-Options: nosniff\r\n"
    "Referrer-Policy: no-referrer\r\n"
    "Cache-Control: no-store\r\n"
    "Connection: close\r\n";

// Returns the host, with its port, of a target in absolute form (RFC 9112, section 3.2.2), and
// removes what is before the path; empty for the usual form, and where the path does not follow.
std::string TakeHost(absl::string_view* target) {
  for (const absl::string_view scheme : {"http://", "https://"}) {
    if (!absl::StartsWithIgnoreCase(*target, scheme)) continue;
    const absl::string_view rest = target->substr(scheme.size());
    const size_t length = std::min(rest.find_first_of("/?"), rest.size());
    if (length == 0) break;
    *target = length == rest.size() ? "/" : rest.substr(length);
    return std::string(rest.substr(0, length));
  }
  return "";
}

}  // namespace

HttpResponse JsonError(int code, absl::string_view message) {
  return {.code = code, .content_type = "application/json", .body = HttpErrorBody(message)};
}

HttpResponse TooLongError(const HttpRequest& request, int64_t most) {
  return JsonError(413, absl::StrCat("Content-Length: expected at most ", most,
                                     " (--max_message_bytes), received ", request.body_length));
}

int HttpCode(absl::StatusCode code) {
  switch (code) {
    case absl::StatusCode::kInvalidArgument:
      return 400;
    case absl::StatusCode::kUnauthenticated:
      return 401;
    case absl::StatusCode::kPermissionDenied:
      return 403;
    case absl::StatusCode::kNotFound:
      return 404;
    case absl::StatusCode::kFailedPrecondition:
      return 409;
    case absl::StatusCode::kResourceExhausted:
      return 429;
    case absl::StatusCode::kUnavailable:
      return 503;
    default:
      return 500;
  }
}

absl::StatusOr<std::string> TakeBody(HttpRequest* request) {
  std::string body = std::exchange(request->body, {});
  if (!request->is_gzip) return body;
  return Gunzip(body, request->longest_body);
}

absl::StatusOr<std::string> DecodeTarget(absl::string_view target, HttpRequest* request) {
  const absl::Status invalid = absl::InvalidArgumentError(
      "target: expected a path that begins with / and percent-encoded bytes");
  const std::string host = TakeHost(&target);
  if (target.empty() || target[0] != '/') return invalid;
  const std::pair<absl::string_view, absl::string_view> parts =
      absl::StrSplit(target, absl::MaxSplits('?', 1));
  auto path = PercentDecode(parts.first);
  if (!path) return invalid;
  request->path = *std::move(path);
  for (const absl::string_view parameter : absl::StrSplit(parts.second, '&', absl::SkipEmpty())) {
    const std::pair<absl::string_view, absl::string_view> pair =
        absl::StrSplit(parameter, absl::MaxSplits('=', 1));
    auto name = PercentDecode(pair.first, /*is_query=*/true);
    auto value = PercentDecode(pair.second, /*is_query=*/true);
    if (!name || !value) return invalid;
    request->parameters.emplace(*std::move(name), *std::move(value));
  }
  return host;
}

std::string HeadersOf(const HttpResponse& response, absl::string_view more_headers) {
  const auto reason = boost::beast::http::obsolete_reason(
      boost::beast::http::int_to_status(static_cast<unsigned>(response.code)));
  return absl::StrCat(
      "HTTP/1.1 ", response.code, " ", absl::string_view(reason.data(), reason.size()), "\r\n",
      kPageHeaders, response.code == 401 ? "WWW-Authenticate: Basic realm=\"spikeserve\"\r\n" : "",
      response.headers, more_headers, "Content-Type: ", response.content_type, "\r\n",
      // Without a length, the body ends with the connection.
      response.feed == nullptr ? absl::StrCat("Content-Length: ", response.body.size(), "\r\n")
                               : "",
      "\r\n");
}

}  // namespace spikeserve
