#include "server/policy_settings.h"

#include <filesystem>
#include <fstream>
#include <sstream>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/model/atomic_file.h"
#include "core/model/json.h"
#include "server/strict_json.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

absl::StatusOr<int64_t> ParseVersion(const std::string& field, const Json& json) {
  if (!json.is_number_integer() || json.get<int64_t>() < 1) {
    return UnexpectedJson(field, "a version of at least 1", json);
  }
  return json.get<int64_t>();
}

absl::StatusOr<TrafficShare> ParseShare(const std::string& field, const Json& json) {
  if (auto status = CheckKeys(field, json, {"version", "percent"}); !status.ok()) return status;
  const auto version = ParseVersion(absl::StrCat(field, ".version"), json.value("version", Json()));
  if (!version.ok()) return version.status();
  const Json percent = json.value("percent", Json());
  if (!percent.is_number_integer() || percent.get<int64_t>() < 0 || percent.get<int64_t>() > 100) {
    return UnexpectedJson(absl::StrCat(field, ".percent"), "an integer in [0, 100]", percent);
  }
  return TrafficShare{.version = *version, .percent = percent.get<int>()};
}

absl::StatusOr<PolicySettings> ParsePolicy(const std::string& field, const Json& json) {
  if (auto status =
          CheckKeys(field, json, {"default_version", "labels", "shares", "shadow_version"});
      !status.ok()) {
    return status;
  }
  PolicySettings settings;
  for (const auto& [key, target] : {std::pair("default_version", &settings.default_version),
                                    std::pair("shadow_version", &settings.shadow_version)}) {
    if (!json.contains(key)) continue;
    const auto version = ParseVersion(absl::StrCat(field, ".", key), json[key]);
    if (!version.ok()) return version.status();
    *target = *version;
  }
  const Json labels = json.value("labels", Json::object());
  if (!labels.is_object()) {
    return UnexpectedJson(absl::StrCat(field, ".labels"), "an object", labels);
  }
  for (const auto& [label, value] : labels.items()) {
    const auto version = ParseVersion(absl::StrCat(field, ".labels.", label), value);
    if (!version.ok()) return version.status();
    settings.labels[label] = *version;
  }
  const Json shares = json.value("shares", Json::array());
  if (!shares.is_array()) return UnexpectedJson(absl::StrCat(field, ".shares"), "an array", shares);
  for (size_t i = 0; i < shares.size(); ++i) {
    const auto share = ParseShare(absl::StrCat(field, ".shares[", i, "]"), shares[i]);
    if (!share.ok()) return share.status();
    settings.shares.push_back(*share);
  }
  return settings;
}

Json PolicyJson(const PolicySettings& settings) {
  Json json = Json::object();
  if (settings.default_version != 0) json["default_version"] = settings.default_version;
  if (!settings.labels.empty()) json["labels"] = settings.labels;
  for (const TrafficShare& share : settings.shares) {
    json["shares"].push_back({{"version", share.version}, {"percent", share.percent}});
  }
  if (settings.shadow_version != 0) json["shadow_version"] = settings.shadow_version;
  return json;
}

}  // namespace

absl::StatusOr<Settings> ParseSettings(absl::string_view text) {
  const auto json = ParseJsonObject("settings", text);
  if (!json.ok()) return json.status();
  if (auto status = CheckKeys("settings", *json, {"policies", "unloaded"}); !status.ok()) {
    return status;
  }
  Settings settings;
  const Json policies = json->value("policies", Json::object());
  if (!policies.is_object()) return UnexpectedJson("policies", "an object", policies);
  for (const auto& [name, value] : policies.items()) {
    auto policy = ParsePolicy(absl::StrCat("policies.", name), value);
    if (!policy.ok()) return policy.status();
    settings.policies[name] = *std::move(policy);
  }
  const Json unloaded = json->value("unloaded", Json::object());
  if (!unloaded.is_object()) return UnexpectedJson("unloaded", "an object", unloaded);
  for (const auto& [name, versions] : unloaded.items()) {
    const std::string field = absl::StrCat("unloaded.", name);
    if (!versions.is_array()) return UnexpectedJson(field, "an array", versions);
    for (const Json& value : versions) {
      const auto version = ParseVersion(field, value);
      if (!version.ok()) return version.status();
      settings.unloaded.insert({.policy = name, .version = *version});
    }
  }
  return settings;
}

std::string ToJson(const Settings& settings) {
  Json json = {{"policies", Json::object()}, {"unloaded", Json::object()}};
  for (const auto& [name, policy] : settings.policies) {
    if (policy != PolicySettings()) json["policies"][name] = PolicyJson(policy);
  }
  for (const PolicyVersion& version : settings.unloaded) {
    json["unloaded"][version.policy].push_back(version.version);
  }
  return json.dump(2) + "\n";
}

absl::StatusOr<Settings> ReadSettings(const std::string& path) {
  std::error_code error;
  if (std::filesystem::symlink_status(path, error).type() ==
      std::filesystem::file_type::not_found) {
    return Settings();
  }
  std::ifstream file(path, std::ios::binary);
  std::ostringstream text;
  if (!file || !(text << file.rdbuf())) {
    return absl::InvalidArgumentError(absl::StrCat(path, ": expected a file that can be read"));
  }
  auto settings = ParseSettings(std::move(text).str());
  if (settings.ok()) return settings;
  return absl::InvalidArgumentError(absl::StrCat(path, ": ", settings.status().message()));
}

absl::Status WriteSettings(const Settings& settings, const std::string& path) {
  const std::string text = ToJson(settings);
  return WriteFileAtomically(path, {text});
}

}  // namespace spikeserve
