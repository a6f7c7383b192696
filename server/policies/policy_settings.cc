#include "server/policies/policy_settings.h"

#include <filesystem>
#include <fstream>
#include <set>
#include <sstream>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/strict_json.h"

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
          CheckKeys(field, json,
                    {"default_version", "labels", "shares", "shadow_version", "learning_paused"});
      !status.ok()) {
    return status;
  }
  PolicySettings settings;
  const Json paused = json.value("learning_paused", Json(false));
  if (!paused.is_boolean()) {
    return UnexpectedJson(absl::StrCat(field, ".learning_paused"), "true or false", paused);
  }
  settings.learning_paused = paused.get<bool>();
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
    if (!IsPlainName(label)) {
      return absl::InvalidArgumentError(absl::StrCat(
          field, ".labels: expected letters, digits, '.', '-', '_', received ", Quoted(label)));
    }
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
  if (auto status = CheckShares(settings.shares); !status.ok()) {
    return absl::InvalidArgumentError(absl::StrCat(field, ".", status.message()));
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
  if (settings.learning_paused) json["learning_paused"] = true;
  return json;
}

}  // namespace

std::string PolicySettings::UseOf(int64_t version) const {
  if (version == default_version) return "the default";
  for (const auto& [label, labelled] : labels) {
    if (labelled == version) return absl::StrCat("label ", label);
  }
  for (const TrafficShare& share : shares) {
    if (share.version == version) return absl::StrCat(share.percent, "% of the traffic");
  }
  return version == shadow_version ? "the shadow" : "";
}

int PolicySettings::PercentOf(int64_t version) const {
  for (const TrafficShare& share : shares) {
    if (share.version == version) return share.percent;
  }
  return 0;
}

absl::Status CheckShares(const std::vector<TrafficShare>& shares) {
  int sum = 0;
  std::set<int64_t> seen;
  for (const TrafficShare& share : shares) {
    if (share.percent < 0 || share.percent > 100) {
      return absl::InvalidArgumentError(
          absl::StrCat("shares: expected percents in [0, 100], received ", share.percent,
                       " for version ", share.version));
    }
    if (!seen.insert(share.version).second) {
      return absl::InvalidArgumentError(
          absl::StrCat("shares: expected each version once, received ", share.version, " twice"));
    }
    sum += share.percent;
  }
  if (shares.empty() || sum == 100) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("shares: expected percents that add up to 100, received ", sum));
}

PolicySettings EffectiveSettings(const PolicySettings& settings, const std::set<int64_t>& versions,
                                 std::vector<std::string>* waiting) {
  PolicySettings holding = settings;
  const auto waits = [&](const std::string& setting, int64_t version) {
    if (version == 0 || versions.contains(version)) return false;
    waiting->push_back(
        absl::StrCat(setting, ": waits for version ", version, ", which is not served"));
    return true;
  };
  if (waits("default_version", settings.default_version)) holding.default_version = 0;
  for (const auto& [label, version] : settings.labels) {
    if (waits(absl::StrCat("labels.", label), version)) holding.labels.erase(label);
  }
  for (const TrafficShare& share : settings.shares) {
    if (waits("shares", share.version)) holding.shares.clear();
  }
  if (waits("shadow_version", settings.shadow_version)) holding.shadow_version = 0;
  return holding;
}

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
  const auto text = ReadFile(path);
  if (!text.ok()) return text.status();
  auto settings = ParseSettings(*text);
  if (settings.ok()) return settings;
  return Annotate(settings.status(), path);
}

absl::Status WriteSettings(const Settings& settings, const std::string& path) {
  const std::string text = ToJson(settings);
  return WriteFileAtomically(path, {text});
}

}  // namespace spikeserve
