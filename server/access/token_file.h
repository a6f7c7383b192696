// Parses the tokens file, which lists the valid tokens with their tenants, roles and limits:
//
//   {"tenants": {"fleet-a": {"max_sessions": 100, "decisions_per_second": 5000,
//                            "max_message_bytes": 65536, "max_durability": "async",
//                            "calls_per_second": {"light": 5000, "listing": 100, "explain": 20,
//                                                 "operator": 100},
//                            "budgets": {"decisions": 1e9, "joules": {"int_sram_45nm": 50},
//                                        "contributions": 1000, "open_sessions": "go_on"}}},
//    "tokens": [{"sha256": "<64 hexadecimal digits>", "tenant": "fleet-a", "role": "agent",
//                "expires": "2027-01-31T00:00:00Z"},
//               {"sha256": "...", "tenant": "fleet-a", "role": "operator", "sees": "all",
//                "name": "alice"},
//               {"sha256": "...", "tenant": "fleet-a", "role": "agent", "learning": false}]}
//
// `budgets` are of a calendar month of UTC. When one is spent, the tenant opens no more sessions;
// with `"open_sessions": "stop"` its open sessions decide nothing either.
// max_durability is none, async or sync. An absent limit does not apply, except that several
// tenants share --max_sessions (TenantLimits::max_sessions). Sessions of a token with `"learning":
// false` cannot learn. A token without `expires` is valid until it is removed. `sees` tells whose
// sessions the token may read: those of its "tenant" (the default) or "all". The file holds hashes
// of tokens, so reading the file does not give access to the server.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "nlohmann/json.hpp"
#include "server/access/role.h"
#include "server/access/tenant.h"

namespace spikeserve {

using Digest = std::array<uint8_t, 32>;

// Returns the SHA-256 digest of `bytes`. Safe to call from many threads; allocates and locks only
// in the first call of a thread.
Digest Sha256(absl::string_view bytes);

struct TokenEntry {
  Digest sha256 = {};
  std::string tenant = "";
  Role role = Role::kAgent;
  absl::Time expires = absl::InfiniteFuture();
  bool sees_all = false;  // may read the sessions of every tenant
  std::string name = "";  // of its holder, for the history of operators' actions
  bool may_learn = true;  // may open sessions that learn

  bool operator==(const TokenEntry&) const = default;
};

// Read one token, or the limits of one tenant and their parts; JsonObject calls these. Errors are
// INVALID_ARGUMENT with a path that starts with `field`.
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, TokenEntry* entry);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, TenantLimits* limits);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, CallRates* rates);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, UsageBudgets* budgets);

struct TokenFile {
  std::map<std::string, TenantLimits> tenants;
  std::vector<TokenEntry> tokens;
};

// Parses the text of a tokens file. Returns INVALID_ARGUMENT that names the field, the expected and
// the received value, for an unknown key, role or tenant, a malformed hash or a duplicate hash.
absl::StatusOr<TokenFile> ParseTokenFile(absl::string_view text);

}  // namespace spikeserve
