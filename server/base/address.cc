#include "server/base/address.h"

#include <algorithm>

#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

constexpr absl::string_view kUnixPrefix = "unix:";

bool IsHost(absl::string_view host) {
  const bool bracketed = host.size() > 2 && host.front() == '[' && host.back() == ']';
  if (bracketed) host = host.substr(1, host.size() - 2);
  return !host.empty() && std::all_of(host.begin(), host.end(), [&](char c) {
    return absl::ascii_isalnum(c) || c == '.' || c == '-' || c == '_' || (bracketed && c == ':');
  });
}

}  // namespace

std::string Address::ToString() const {
  return is_unix() ? absl::StrCat(kUnixPrefix, unix_path) : absl::StrCat(host, ":", port);
}

bool Address::is_loopback() const {
  return is_unix() || host == "localhost" || host == "[::1]" ||
         (absl::StartsWith(host, "127.") && host.find_first_not_of("0123456789.") == host.npos);
}

absl::StatusOr<Address> ParseAddress(absl::string_view field, absl::string_view text) {
  const size_t colon = text.rfind(':');
  Address address;
  if (colon == absl::string_view::npos || !IsHost(text.substr(0, colon)) ||
      !absl::SimpleAtoi(text.substr(colon + 1), &address.port) || address.port < 0 ||
      address.port > 65535) {
    return InvalidArgument(field, "HOST:PORT", absl::StrCat("\"", text, "\""));
  }
  address.host = std::string(text.substr(0, colon));
  return address;
}

absl::StatusOr<Address> ParseAddressOrUnix(absl::string_view field, absl::string_view text) {
  if (!absl::StartsWith(text, kUnixPrefix)) return ParseAddress(field, text);
  Address address;
  address.unix_path = std::string(text.substr(kUnixPrefix.size()));
  if (address.is_unix()) return address;
  return InvalidArgument(field, "a path after unix:", "none");
}

}  // namespace spikeserve
