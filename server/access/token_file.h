// The file that says which tokens are good, whose they are and what they allow:
//
//   {"tenants": {"fleet-a": {"max_sessions": 100, "decisions_per_second": 5000,
//                            "max_message_bytes": 65536}},
//    "tokens": [{"sha256": "<64 hexadecimal digits>", "tenant": "fleet-a", "role": "agent",
//                "expires": "2027-01-31T00:00:00Z"},
//               {"sha256": "...", "tenant": "fleet-a", "role": "operator", "sees": "all"}]}
//
// Limits that are left out do not apply; a token without `expires` is good until it is removed; one
// without `sees` sees the sessions of its "tenant" alone. The file holds hashes, so that whoever
// reads it cannot call.
#ifndef SERVER_ACCESS_TOKEN_FILE_H_
#define SERVER_ACCESS_TOKEN_FILE_H_

#include <array>
#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "nlohmann/json.hpp"
#include "server/access/tenant.h"
#include "server/base/role.h"

namespace spikeserve {

using Digest = std::array<uint8_t, 32>;

// SHA-256. Safe to call from many threads; allocates and locks only in a thread's first call.
Digest Sha256(absl::string_view bytes);

struct TokenEntry {
  Digest sha256 = {};
  std::string tenant = "";
  Role role = Role::kAgent;
  absl::Time expires = absl::InfiniteFuture();
  bool sees_all = false;  // the sessions of every tenant, to look at

  bool operator==(const TokenEntry&) const = default;
};
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, TokenEntry* entry);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, TenantLimits* limits);

struct TokenFile {
  std::map<std::string, TenantLimits> tenants;
  std::vector<TokenEntry> tokens;
};

// Nothing is guessed: an unknown key, role or tenant, a hash that comes twice or is not one, is an
// error that names the field, what was expected and what came.
absl::StatusOr<TokenFile> ParseTokenFile(absl::string_view text);

}  // namespace spikeserve

#endif  // SERVER_ACCESS_TOKEN_FILE_H_
