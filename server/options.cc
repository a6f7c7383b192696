#include "server/options.h"

#include <climits>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
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
    return advertise.empty() ? absl::OkStatus()
                             : InvalidArgument("--datagram_advertise",
                                               "none without --datagram_listen", advertise);
  }
  ASSIGN_OR_RETURN(const auto address, ParseAddress("--datagram_listen", options.datagram_listen));
  RETURN_IF_ERROR(CheckReach("--datagram_listen", options.datagram_listen, options));
  if (!advertise.empty()) return ParseAddress("--datagram_advertise", advertise).status();
  if (address.host != "0.0.0.0" && address.host != "[::]") return absl::OkStatus();
  return InvalidArgument(
      "--datagram_advertise",
      absl::StrCat("the HOST:PORT that robots reach, because --datagram_listen is ",
                   options.datagram_listen),
      "none");
}

absl::Status CheckCounts(const ServerOptions& options) {
  for (const auto& [flag, value] :
       {std::pair("--max_sessions", options.max_sessions),
        std::pair("--max_recorded_bytes", options.max_recorded_bytes),
        std::pair("--max_policy_bytes", options.max_policy_bytes),
        std::pair("--max_pushed_versions", options.max_pushed_versions)}) {
    if (value >= 1) continue;
    return InvalidArgument(flag, "at least 1", value);
  }
  return absl::OkStatus();
}

absl::Status CheckStore(const ServerOptions& options) {
  if (options.store.retention < options.session_ttl) {
    return InvalidArgument(
        "--store_retention",
        absl::StrCat("at least --session_ttl, ", absl::FormatDuration(options.session_ttl)),
        absl::FormatDuration(options.store.retention));
  }
  return options.store.Validate();
}

absl::Status CheckAtLeast(absl::string_view flag, absl::Duration value, absl::Duration least) {
  if (value < least) {
    return InvalidArgument(flag, absl::StrCat("at least ", absl::FormatDuration(least)),
                           absl::FormatDuration(value));
  }
  return absl::OkStatus();
}

}  // namespace

absl::Status ServerOptions::Validate() const {
  if (policies.empty()) {
    return InvalidArgument("--policies", "a directory", "none");
  }
  RETURN_IF_ERROR(tls.Validate());
  RETURN_IF_ERROR(CheckReach("--listen", listen, *this));
  RETURN_IF_ERROR(CheckDatagrams(*this));
  RETURN_IF_ERROR(transport_limits.Validate());
  if (loops < 0 || loops > kMostLoops) {
    return InvalidArgument("--loops", absl::StrCat("0 to ", kMostLoops), loops);
  }
  if (!http_listen.empty()) {
    RETURN_IF_ERROR(CheckReach("--http_listen", http_listen, *this));
  }
  RETURN_IF_ERROR(Origins::Parse("--http_origins", http_origins).status());
  RETURN_IF_ERROR(CheckAtLeast("--session_ttl", session_ttl, absl::Milliseconds(1)));
  if (poll_policies != absl::ZeroDuration() && poll_policies < absl::Milliseconds(1)) {
    return InvalidArgument("--poll_policies", "0 or at least 1ms",
                           absl::FormatDuration(poll_policies));
  }
  RETURN_IF_ERROR(CheckAtLeast("--compact_after", compact_after, absl::Milliseconds(1)));
  if (!signing_key.empty() && trusted_keys.empty()) {
    return InvalidArgument("--signing_key", "--trusted_keys, too", "none");
  }
  if (!(unusual_deviations >= 0.0)) {
    return InvalidArgument("--unusual_deviations", "at least 0", unusual_deviations);
  }
  RETURN_IF_ERROR(ParseWiringRules(wiring).status());
  RETURN_IF_ERROR(CheckCounts(*this));
  RETURN_IF_ERROR(CheckStore(*this));
  RETURN_IF_ERROR(CheckAtLeast("--usage_interval", usage.interval, absl::Milliseconds(10)));
  if (max_message_bytes < 1 || max_message_bytes > INT_MAX) {
    return InvalidArgument("--max_message_bytes", absl::StrCat("1 to ", INT_MAX),
                           max_message_bytes);
  }
  if (drain_timeout < absl::ZeroDuration()) {
    return InvalidArgument("--drain_timeout", "a duration of at least 0",
                           absl::FormatDuration(drain_timeout));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
