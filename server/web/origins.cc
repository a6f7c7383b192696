#include "server/web/origins.h"

#include "absl/algorithm/container.h"
#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "core/base/json.h"

namespace spikeserve {
namespace {

// An origin as browsers send it: a scheme and a host in lower case, with a port if it is unusual.
bool IsOrigin(absl::string_view text) {
  if (!absl::ConsumePrefix(&text, "https://") && !absl::ConsumePrefix(&text, "http://")) {
    return false;
  }
  return !text.empty() && absl::c_all_of(text, [](char c) {
    return absl::ascii_islower(c) || absl::ascii_isdigit(c) ||
           absl::string_view("-.:[]").find(c) != absl::string_view::npos;
  });
}

}  // namespace

absl::StatusOr<Origins> Origins::Parse(absl::string_view flag, absl::string_view text) {
  Origins origins;
  for (const absl::string_view origin : absl::StrSplit(text, ',', absl::SkipEmpty())) {
    if (!IsOrigin(origin)) {
      return absl::InvalidArgumentError(absl::StrCat(
          flag, ": expected origins such as https://robots.example, separated by commas, received ",
          Quoted(origin)));
    }
    origins.allowed_.emplace_back(origin);
  }
  return origins;
}

bool Origins::Allow(absl::string_view origin) const {
  return absl::c_linear_search(allowed_, origin);
}

std::string Origins::HeadersFor(absl::string_view origin) const {
  if (!Allow(origin)) return "";
  return absl::StrCat("Access-Control-Allow-Origin: ", origin,
                      "\r\nVary: Origin\r\n"
                      "Access-Control-Expose-Headers: grpc-status, grpc-message, "
                      "grpc-status-details-bin, inference-header-content-length\r\n");
}

HttpResponse Origins::Preflight(absl::string_view origin) const {
  if (!Allow(origin)) {
    return {.code = 403, .body = "Origin: expected one of --http_origins\n"};
  }
  return {.body = "",
          .headers =
              "Access-Control-Allow-Methods: GET, POST\r\n"
              "Access-Control-Allow-Headers: authorization, content-type, content-encoding, "
              "grpc-timeout, inference-header-content-length, traceparent, x-grpc-web, "
              "x-user-agent\r\n"
              "Access-Control-Max-Age: 600\r\n"};
}

bool IsOwnOrigin(absl::string_view origin, absl::string_view host, bool has_tls) {
  const bool has_scheme = absl::ConsumePrefix(&origin, "https://") ||
                          (!has_tls && absl::ConsumePrefix(&origin, "http://"));
  return has_scheme && !host.empty() && absl::EqualsIgnoreCase(origin, host);
}

absl::string_view WithoutPort(absl::string_view host) {
  const size_t colon = host.rfind(':');
  const bool has_port = colon != absl::string_view::npos && host.find(']', colon) == host.npos;
  return has_port ? host.substr(0, colon) : host;
}

bool IsNobodyElses(absl::string_view host) {
  host = WithoutPort(host);
  const bool is_ipv4 = !host.empty() && host.find_first_not_of("0123456789.") == host.npos;
  return is_ipv4 || absl::StartsWith(host, "[") || host == "localhost";
}

}  // namespace spikeserve
