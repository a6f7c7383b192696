#include "server/access/token_file.h"

#include <openssl/evp.h>

#include <algorithm>
#include <memory>
#include <set>

#include "absl/strings/ascii.h"
#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/strict_json.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

absl::StatusOr<TenantLimits> ParseLimits(const std::string& field, const Json& json) {
  if (auto status =
          CheckKeys(field, json, {"max_sessions", "decisions_per_second", "max_message_bytes"});
      !status.ok()) {
    return status;
  }
  TenantLimits limits;
  for (const auto& [key, value] : json.items()) {
    const bool whole = key != "decisions_per_second";
    if (whole ? !value.is_number_integer() : !value.is_number()) {
      return UnexpectedJson(absl::StrCat(field, ".", key), whole ? "an integer" : "a number",
                            value);
    }
    if (key == "max_sessions") limits.max_sessions = value.get<int64_t>();
    if (key == "max_message_bytes") limits.max_message_bytes = value.get<int64_t>();
    if (key == "decisions_per_second") limits.decisions_per_second = value.get<double>();
  }
  if (auto status = limits.Validate(); !status.ok()) {
    return absl::InvalidArgumentError(absl::StrCat(field, ".", status.message()));
  }
  return limits;
}

// A member that is text; empty where it may be absent.
absl::StatusOr<std::string> Text(const std::string& field, const Json& object, const char* key,
                                 bool required) {
  const auto member = object.find(key);
  if (member == object.end() && !required) return std::string();
  if (member == object.end() || !member->is_string()) {
    return UnexpectedJson(absl::StrCat(field, ".", key), "text",
                          member == object.end() ? Json() : *member);
  }
  return member->get<std::string>();
}

absl::StatusOr<Digest> ParseDigest(const std::string& field, const std::string& text) {
  Digest digest = {};
  if (text.size() != 2 * digest.size() ||
      !std::all_of(text.begin(), text.end(), [](char c) { return absl::ascii_isxdigit(c); })) {
    return absl::InvalidArgumentError(absl::StrCat(
        field, ".sha256: expected 64 hexadecimal digits, received ", text.size(), " characters"));
  }
  const std::string bytes = absl::HexStringToBytes(text);
  std::copy(bytes.begin(), bytes.end(), digest.begin());
  return digest;
}

absl::StatusOr<TokenEntry> ParseToken(const std::string& field, const Json& json,
                                      const std::map<std::string, TenantLimits>& tenants) {
  if (auto status = CheckKeys(field, json, {"sha256", "tenant", "role", "expires", "sees"});
      !status.ok()) {
    return status;
  }
  const auto hash = Text(field, json, "sha256", /*required=*/true);
  const auto tenant = Text(field, json, "tenant", /*required=*/true);
  const auto role = Text(field, json, "role", /*required=*/true);
  const auto expires = Text(field, json, "expires", /*required=*/false);
  const auto sees = Text(field, json, "sees", /*required=*/false);
  for (const auto* text : {&hash, &tenant, &role, &expires, &sees}) {
    if (!text->ok()) return text->status();
  }
  const auto digest = ParseDigest(field, *hash);
  if (!digest.ok()) return digest.status();
  TokenEntry entry = {.sha256 = *digest, .tenant = *tenant};
  if (!tenants.contains(*tenant)) {
    return absl::InvalidArgumentError(
        absl::StrCat(field, ".tenant: expected one of `tenants`, received ", Quoted(*tenant)));
  }
  const auto parsed_role = ParseEnum<Role>(absl::StrCat(field, ".role"), *role);
  if (!parsed_role.ok()) return parsed_role.status();
  entry.role = *parsed_role;
  std::string ignored;
  if (!expires->empty() &&
      !absl::ParseTime(absl::RFC3339_full, *expires, &entry.expires, &ignored)) {
    return absl::InvalidArgumentError(
        absl::StrCat(field, ".expires: expected a time such as 2027-01-31T00:00:00Z, received ",
                     Quoted(*expires)));
  }
  entry.sees_all = *sees == "all";
  if (!entry.sees_all && *sees != "tenant" && json.contains("sees")) {
    return absl::InvalidArgumentError(
        absl::StrCat(field, ".sees: expected tenant or all, received ", Quoted(*sees)));
  }
  if (entry.sees_all && entry.role == Role::kAgent) {
    return absl::InvalidArgumentError(
        absl::StrCat(field, ".sees: expected tenant for an agent, received \"all\""));
  }
  return entry;
}

}  // namespace

Digest Sha256(absl::string_view bytes) {
  // Fetching the algorithm takes OpenSSL's global lock; a context that has it is used again.
  static const EVP_MD* const kSha256 = EVP_MD_fetch(nullptr, "SHA256", nullptr);
  struct Free {
    void operator()(EVP_MD_CTX* context) const { EVP_MD_CTX_free(context); }
  };
  thread_local const std::unique_ptr<EVP_MD_CTX, Free> context(EVP_MD_CTX_new());
  Digest digest = {};
  EVP_DigestInit_ex(context.get(), kSha256, nullptr);
  EVP_DigestUpdate(context.get(), bytes.data(), bytes.size());
  EVP_DigestFinal_ex(context.get(), digest.data(), nullptr);
  return digest;
}

absl::StatusOr<TokenFile> ParseTokenFile(absl::string_view text) {
  const auto json = ParseJsonObject("tokens file", text);
  if (!json.ok()) return json.status();
  if (auto status = CheckKeys("tokens file", *json, {"tenants", "tokens"}); !status.ok()) {
    return status;
  }
  TokenFile file;
  const Json tenants = json->value("tenants", Json::object());
  if (!tenants.is_object()) return UnexpectedJson("tenants", "an object", tenants);
  for (const auto& [name, limits] : tenants.items()) {
    if (name.empty()) return absl::InvalidArgumentError("tenants: expected names, received none");
    auto parsed = ParseLimits(absl::StrCat("tenants.", name), limits);
    if (!parsed.ok()) return parsed.status();
    file.tenants.emplace(name, *parsed);
  }
  const Json tokens = json->value("tokens", Json::array());
  if (!tokens.is_array()) return UnexpectedJson("tokens", "an array", tokens);
  std::set<Digest> seen;
  for (size_t i = 0; i < tokens.size(); ++i) {
    const std::string field = absl::StrCat("tokens[", i, "]");
    auto entry = ParseToken(field, tokens[i], file.tenants);
    if (!entry.ok()) return entry.status();
    if (!seen.insert(entry->sha256).second) {
      return absl::InvalidArgumentError(
          absl::StrCat(field, ".sha256: expected each hash once, received one again"));
    }
    file.tokens.push_back(*std::move(entry));
  }
  return file;
}

}  // namespace spikeserve
