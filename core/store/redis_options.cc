#include "core/store/redis_options.h"

#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "core/base/file.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

// Parses HOST[:PORT] or [IPV6][:PORT].
std::optional<RedisEndpoint> ParseEndpoint(absl::string_view text, int default_port) {
  RedisEndpoint endpoint = {.host = "", .port = default_port};
  const size_t bracket = absl::StartsWith(text, "[") ? text.find(']') : 0;
  if (bracket == absl::string_view::npos) return std::nullopt;
  const size_t colon = text.find(':', bracket);
  endpoint.host = std::string(text.substr(0, colon));
  if (bracket > 0) {
    endpoint.host = std::string(text.substr(1, bracket - 1));
    if (colon == absl::string_view::npos ? bracket + 1 != text.size() : colon != bracket + 1) {
      return std::nullopt;
    }
  }
  if (endpoint.host.empty()) return std::nullopt;
  if (colon == absl::string_view::npos) return endpoint;
  if (!absl::SimpleAtoi(text.substr(colon + 1), &endpoint.port)) return std::nullopt;
  if (endpoint.port < 1 || endpoint.port > kLargestPort) return std::nullopt;
  return endpoint;
}

}  // namespace

std::string RedisEndpoint::ToString() const {
  return absl::StrContains(host, ':') ? absl::StrCat("[", host, "]:", port)
                                      : absl::StrCat(host, ":", port);
}

std::optional<RedisAddress> ParseRedisAddress(absl::string_view text) {
  RedisAddress address;
  if (!absl::ConsumePrefix(&text, "redis")) return std::nullopt;
  address.tls = absl::ConsumePrefix(&text, "s");
  const bool sentinel = absl::ConsumePrefix(&text, "+sentinel");
  if (!absl::ConsumePrefix(&text, "://")) return std::nullopt;
  if (const size_t at = text.substr(0, text.find('/')).rfind('@'); at != absl::string_view::npos) {
    address.user = std::string(text.substr(0, at));
    if (address.user.empty() || absl::StrContains(address.user, ':')) return std::nullopt;
    text.remove_prefix(at + 1);
  }
  std::vector<absl::string_view> parts = absl::StrSplit(text, '/');
  for (const absl::string_view host : absl::StrSplit(parts[0], ',')) {
    auto endpoint = ParseEndpoint(host, sentinel ? kSentinelPort : kRedisPort);
    if (!endpoint.has_value()) return std::nullopt;
    address.endpoints.push_back(*std::move(endpoint));
  }
  parts.erase(parts.begin());
  if (sentinel) {
    if (parts.empty() || parts[0].empty()) return std::nullopt;
    address.primary = std::string(parts[0]);
    parts.erase(parts.begin());
  }
  if (parts.empty()) return address;
  if (parts.size() > 1) return std::nullopt;
  if (!absl::SimpleAtoi(parts[0], &address.database) || address.database < 0) return std::nullopt;
  return address;
}

absl::Status CheckNoRedisPassword(absl::string_view text) {
  const size_t begin = text.find("://");
  if (!absl::StartsWith(text, "redis") || begin == absl::string_view::npos) {
    return absl::OkStatus();
  }
  const absl::string_view rest = text.substr(begin + 3);
  const absl::string_view user = rest.substr(0, rest.rfind('@'));
  if (user.size() == rest.size() || !absl::StrContains(user, ':')) return absl::OkStatus();
  return absl::InvalidArgumentError(
      "expected the password of Redis in the file of --store_password_file, received one in the "
      "address");
}

absl::StatusOr<std::string> ReadRedisPassword(const std::string& file) {
  if (file.empty()) return "";
  const auto password = ReadFile(file);
  if (!password.ok()) return Annotate(password.status(), "--store_password_file");
  return std::string(absl::StripAsciiWhitespace(*password));
}

}  // namespace spikeserve
