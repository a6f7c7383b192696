#include "server/web/http_message.h"

#include <boost/beast/http/status.hpp>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "core/base/hex.h"

namespace spikeserve {
namespace {

constexpr absl::string_view kPageHeaders =
    "Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; connect-src "
    "'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n"
    "X-Content-Type-Options: nosniff\r\n"
    "Referrer-Policy: no-referrer\r\n"
    "Cache-Control: no-store\r\n"
    "Connection: close\r\n";

// Decodes %XX. In a query, '+' is a space.
std::optional<std::string> Decode(absl::string_view text, bool is_query) {
  std::string decoded;
  decoded.reserve(text.size());
  for (size_t i = 0; i < text.size(); ++i) {
    if (text[i] == '%') {
      const std::optional<std::string> byte = ParseHex(text.substr(i + 1, 2));
      if (!byte.has_value() || byte->empty()) return std::nullopt;
      decoded += *byte;
      i += 2;
    } else {
      decoded += is_query && text[i] == '+' ? ' ' : text[i];
    }
  }
  return decoded;
}

}  // namespace

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

absl::Status DecodeTarget(absl::string_view target, HttpRequest* request) {
  const absl::Status invalid = absl::InvalidArgumentError(
      "target: expected a path that begins with / and percent-encoded bytes");
  if (target.empty() || target[0] != '/') return invalid;
  const std::pair<absl::string_view, absl::string_view> parts =
      absl::StrSplit(target, absl::MaxSplits('?', 1));
  auto path = Decode(parts.first, /*is_query=*/false);
  if (!path) return invalid;
  request->path = *std::move(path);
  for (const absl::string_view parameter : absl::StrSplit(parts.second, '&', absl::SkipEmpty())) {
    const std::pair<absl::string_view, absl::string_view> pair =
        absl::StrSplit(parameter, absl::MaxSplits('=', 1));
    auto name = Decode(pair.first, /*is_query=*/true);
    auto value = Decode(pair.second, /*is_query=*/true);
    if (!name || !value) return invalid;
    request->parameters.emplace(*std::move(name), *std::move(value));
  }
  return absl::OkStatus();
}

std::string ToBytes(const HttpResponse& response, bool with_body, absl::string_view more_headers) {
  const auto reason = boost::beast::http::obsolete_reason(
      boost::beast::http::int_to_status(static_cast<unsigned>(response.code)));
  return absl::StrCat(
      "HTTP/1.1 ", response.code, " ", absl::string_view(reason.data(), reason.size()), "\r\n",
      kPageHeaders, response.code == 401 ? "WWW-Authenticate: Basic realm=\"spikeserve\"\r\n" : "",
      response.headers, more_headers, "Content-Type: ", response.content_type, "\r\n",
      // Without a length, the body ends with the connection.
      response.feed == nullptr ? absl::StrCat("Content-Length: ", response.body.size(), "\r\n")
                               : "",
      "\r\n", with_body ? absl::string_view(response.body) : absl::string_view());
}

}  // namespace spikeserve
