// The web pages of other sites that may call the server: Cross-Origin Resource Sharing.
#pragma once

#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/web/http_message.h"

namespace spikeserve {

// Immutable. Source: the Fetch standard, "CORS protocol".
class Origins {
 public:
  // Parses origins separated by commas, such as "https://robots.example,http://localhost:8080".
  // Empty: no page may call. Returns INVALID_ARGUMENT if one is no origin of HTTP or HTTPS; "*" is
  // none, because with it any page that somebody opens could move a robot.
  static absl::StatusOr<Origins> Parse(absl::string_view flag, absl::string_view text);

  bool Allow(absl::string_view origin) const;

  // Returns the headers, each with "\r\n", that let a page of `origin` read an answer; none if it
  // may not.
  std::string HeadersFor(absl::string_view origin) const;

  // Returns the answer to a browser that asks whether pages of `origin` may call, without
  // HeadersFor().
  HttpResponse Preflight(absl::string_view origin) const;

 private:
  std::vector<std::string> allowed_;
};

// Returns whether a page of `origin` came from the server that a request names in its header Host,
// as `host`. A proxy may end TLS, so a server without it has pages of https, too.
bool IsOwnOrigin(absl::string_view origin, absl::string_view host, bool has_tls);

// Returns the header Host `host` without its port.
absl::string_view WithoutPort(absl::string_view host);

// Returns whether no site of somebody else can have the name in the header Host, `host`, whatever
// its owner lets it resolve to: it is an address, or a name of this machine.
bool IsNobodyElses(absl::string_view host);

}  // namespace spikeserve
