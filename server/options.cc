#include "server/options.h"

#include <climits>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/base/address.h"
#include "server/web/origins.h"
#include "server/wiring_rules.h"

namespace spikeserve {
namespace {

constexpr int64_t kMostLoops = 256;

// Refuses to serve a network by accident.
absl::Status CheckReach(absl::string_view flag, const std::string& listen,
                        const ServerOptions& options) {
  ASSIGN_OR_RETURN(const auto address, ParseAddressOrUnix(flag, listen));
  if (address.is_loopback() || options.insecure_network) return absl::OkStatus();
  const auto refuse = [&](absl::string_view expected) {
    return absl::InvalidArgumentError(
        absl::StrCat(flag, ": expected ", expected, " for ", listen,
                     ", which others can reach, or a loopback address, or --insecure_network"));
  };
  if (options.tokens.empty()) return refuse("--tokens");
  return options.tls.enabled() ? absl::OkStatus() : refuse("--tls_certificate");
}

// The key of a channel goes over gRPC, so that datagrams need what gRPC needs.
absl::Status CheckDatagrams(const ServerOptions& options) {
  const std::string& advertise = options.datagram_advertise;
  if (options.datagram_listen.empty()) {
    return advertise.empty()
               ? absl::OkStatus()
               : absl::InvalidArgumentError(absl::StrCat(
                     "--datagram_advertise: expected none without --datagram_listen, received ",
                     advertise));
  }
  ASSIGN_OR_RETURN(const auto address, ParseAddress("--datagram_listen", options.datagram_listen));
  RETURN_IF_ERROR(CheckReach("--datagram_listen", options.datagram_listen, options));
  if (!advertise.empty()) return ParseAddress("--datagram_advertise", advertise).status();
  if (address.host != "0.0.0.0" && address.host != "[::]") return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("--datagram_advertise: expected the HOST:PORT that robots reach, because "
                   "--datagram_listen is ",
                   options.datagram_listen, ", received none"));
}

absl::Status CheckCounts(const ServerOptions& options) {
  for (const auto& [flag, value] :
       {std::pair("--max_sessions", options.max_sessions),
        std::pair("--max_recorded_bytes", options.max_recorded_bytes),
        std::pair("--max_policy_bytes", options.max_policy_bytes),
        std::pair("--max_pushed_versions", options.max_pushed_versions)}) {
    if (value >= 1) continue;
    return absl::InvalidArgumentError(
        absl::StrCat(flag, ": expected at least 1, received ", value));
  }
  return absl::OkStatus();
}

absl::Status CheckStore(const ServerOptions& options) {
  if (options.store.retention < options.session_ttl) {
    return absl::InvalidArgumentError(
        absl::StrCat("--store_retention: expected at least --session_ttl, ",
                     absl::FormatDuration(options.session_ttl), ", received ",
                     absl::FormatDuration(options.store.retention)));
  }
  return options.store.Validate();
}

absl::Status CheckAtLeast(absl::string_view flag, absl::Duration value, absl::Duration least) {
  if (value < least) {
    return absl::InvalidArgumentError(absl::StrCat(flag, ": expected at least ",
                                                   absl::FormatDuration(least), ", received ",
                                                   absl::FormatDuration(value)));
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status ServerOptions::Validate() const {
  if (policies.empty()) {
    return absl::InvalidArgumentError("--policies: expected a directory, received none");
  }
  RETURN_IF_ERROR(tls.Validate());
  RETURN_IF_ERROR(CheckReach("--listen", listen, *this));
  RETURN_IF_ERROR(CheckDatagrams(*this));
  RETURN_IF_ERROR(transport_limits.Validate());
  if (loops < 0 || loops > kMostLoops) {
    return absl::InvalidArgumentError(
        absl::StrCat("--loops: expected 0 to ", kMostLoops, ", received ", loops));
  }
  if (!http_listen.empty()) {
    RETURN_IF_ERROR(CheckReach("--http_listen", http_listen, *this));
  }
  RETURN_IF_ERROR(Origins::Parse("--http_origins", http_origins).status());
  RETURN_IF_ERROR(CheckAtLeast("--session_ttl", session_ttl, absl::Milliseconds(1)));
  if (poll_policies != absl::ZeroDuration() && poll_policies < absl::Milliseconds(1)) {
    return absl::InvalidArgumentError(
        absl::StrCat("--poll_policies: expected 0 or at least 1ms, received ",
                     absl::FormatDuration(poll_policies)));
  }
  RETURN_IF_ERROR(CheckAtLeast("--compact_after", compact_after, absl::Milliseconds(1)));
  if (!signing_key.empty() && trusted_keys.empty()) {
    return absl::InvalidArgumentError("--signing_key: expected --trusted_keys, too, received none");
  }
  if (!(unusual_deviations >= 0.0)) {
    return absl::InvalidArgumentError(
        absl::StrCat("--unusual_deviations: expected at least 0, received ", unusual_deviations));
  }
  RETURN_IF_ERROR(ParseWiringRules(wiring).status());
  RETURN_IF_ERROR(CheckCounts(*this));
  RETURN_IF_ERROR(CheckStore(*this));
  RETURN_IF_ERROR(CheckAtLeast("--usage_interval", usage.interval, absl::Milliseconds(10)));
  if (max_message_bytes < 1 || max_message_bytes > INT_MAX) {
    return absl::InvalidArgumentError(absl::StrCat("--max_message_bytes: expected 1 to ", INT_MAX,
                                                   ", received ", max_message_bytes));
  }
  if (drain_timeout < absl::ZeroDuration()) {
    return absl::InvalidArgumentError(
        absl::StrCat("--drain_timeout: expected a duration of at least 0, received ",
                     absl::FormatDuration(drain_timeout)));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
