#include "server/access/token_file.h"

#include <algorithm>
#include <array>
#include <optional>
#include <set>

#include "absl/strings/str_cat.h"
#include "core/base/hex.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

absl::StatusOr<Digest> ParseDigest(absl::string_view field, const std::string& text) {
  Digest digest = {};
  const std::optional<std::string> bytes = ParseHex(text);
  if (!bytes.has_value() || bytes->size() != digest.size()) {
    return InvalidArgument(absl::StrCat(field, ".sha256"), "64 hexadecimal digits",
                           absl::StrCat(text.size(), " characters"));
  }
  std::copy(bytes->begin(), bytes->end(), digest.begin());
  return digest;
}

absl::StatusOr<absl::Time> ParseExpiry(absl::string_view field, const std::string& text) {
  absl::Time expires;
  std::string error;
  if (absl::ParseTime(absl::RFC3339_full, text, &expires, &error)) return expires;
  return InvalidArgument(absl::StrCat(field, ".expires"), "a time such as 2027-01-31T00:00:00Z",
                         Quoted(text));
}

// The sessions that a token may read: those of its tenant, or those of all tenants.
enum class Sees { kTenant, kAll };

constexpr std::array<EnumName<Sees>, 2> EnumNames(Sees) {
  return {{{Sees::kTenant, "tenant"}, {Sees::kAll, "all"}}};
}

// What a spent budget does to open sessions.
enum class OpenSessions { kGoOn, kStop };

constexpr std::array<EnumName<OpenSessions>, 2> EnumNames(OpenSessions) {
  return {{{OpenSessions::kGoOn, "go_on"}, {OpenSessions::kStop, "stop"}}};
}

}  // namespace

absl::Status ReadJson(absl::string_view field, const Json& json, CallRates* rates) {
  JsonObject object(field, json);
  object.Optional("light", &rates->light);
  object.Optional("listing", &rates->listing);
  object.Optional("explain", &rates->explain);
  object.Optional("operator", &rates->operators);
  return object.Finish();
}

absl::Status ReadJson(absl::string_view field, const Json& json, UsageBudgets* budgets) {
  JsonObject object(field, json);
  OpenSessions open = OpenSessions::kGoOn;
  object.Optional("decisions", &budgets->decisions);
  object.Optional("joules", &budgets->joules);
  object.Optional("contributions", &budgets->contributions);
  object.Optional("open_sessions", &open);
  budgets->stop_open_sessions = open == OpenSessions::kStop;
  return object.Finish();
}

absl::Status ReadJson(absl::string_view field, const Json& json, TenantLimits* limits) {
  JsonObject object(field, json);
  object.Optional("max_sessions", &limits->max_sessions);
  object.Optional("decisions_per_second", &limits->decisions_per_second);
  object.Optional("calls_per_second", &limits->calls_per_second);
  object.Optional("max_message_bytes", &limits->max_message_bytes);
  object.Optional("max_durability", &limits->max_durability);
  object.Optional("budgets", &limits->budgets);
  RETURN_IF_ERROR(object.Finish());
  const auto valid = limits->Validate();
  if (valid.ok()) return valid;
  return absl::InvalidArgumentError(absl::StrCat(field, ".", valid.message()));
}

absl::Status ReadJson(absl::string_view field, const Json& json, TokenEntry* entry) {
  JsonObject object(field, json);
  std::string hash;
  std::optional<std::string> expires;
  Sees sees = Sees::kTenant;
  object.Required("sha256", &hash);
  object.Required("tenant", &entry->tenant);
  object.Required("role", &entry->role);
  object.Optional("expires", &expires);
  object.Optional("sees", &sees);
  object.Optional("name", &entry->name);
  object.Optional("learning", &entry->may_learn);
  RETURN_IF_ERROR(object.Finish());
  ASSIGN_OR_RETURN(entry->sha256, ParseDigest(field, hash));
  if (expires.has_value()) {
    ASSIGN_OR_RETURN(entry->expires, ParseExpiry(field, *expires));
  }
  entry->sees_all = sees == Sees::kAll;
  if (entry->sees_all && entry->role == Role::kAgent) {
    return InvalidArgument(absl::StrCat(field, ".sees"), "tenant for an agent", "\"all\"");
  }
  return absl::OkStatus();
}

Digest Sha256(absl::string_view bytes) { return Sha256BytesOf(bytes); }

absl::StatusOr<TokenFile> ParseTokenFile(absl::string_view text) {
  ASSIGN_OR_RETURN(const auto json, ParseJsonObject("tokens file", text));
  TokenFile file;
  JsonObject object("", json);
  object.Optional("tenants", &file.tenants);
  object.Optional("tokens", &file.tokens);
  RETURN_IF_ERROR(object.Finish());
  if (file.tenants.contains("")) {
    return InvalidArgument("tenants", "names", "an empty one");
  }
  std::set<Digest> seen;
  for (size_t i = 0; i < file.tokens.size(); ++i) {
    const TokenEntry& entry = file.tokens[i];
    if (!file.tenants.contains(entry.tenant)) {
      return InvalidArgument(absl::StrCat("tokens[", i, "].tenant"), "one of `tenants`",
                             Quoted(entry.tenant));
    }
    if (!seen.insert(entry.sha256).second) {
      return InvalidArgument(absl::StrCat("tokens[", i, "].sha256"), "each hash once",
                             "a duplicate");
    }
  }
  return file;
}

}  // namespace spikeserve
