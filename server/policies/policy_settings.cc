#include "server/policies/policy_settings.h"

#include <filesystem>
#include <set>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

absl::Status CheckVersion(absl::string_view field, int64_t version) {
  if (version >= kFirstVersion) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat(field, ": expected an integer of at least ",
                                                 kFirstVersion, ", received ", version));
}

absl::Status CheckLabels(absl::string_view field, const std::map<std::string, int64_t>& labels) {
  for (const auto& [label, version] : labels) {
    if (!IsPlainName(label)) {
      return absl::InvalidArgumentError(absl::StrCat(
          field, ": expected letters, digits, '.', '-', '_', received ", Quoted(label)));
    }
    RETURN_IF_ERROR(CheckVersion(absl::StrCat(field, ".", label), version));
  }
  return absl::OkStatus();
}

Json PolicyJson(const PolicySettings& settings) {
  Json json = Json::object();
  if (settings.default_version != 0) json["default_version"] = settings.default_version;
  if (settings.default_follows_highest) json["default_follows_highest"] = true;
  if (!settings.labels.empty()) json["labels"] = settings.labels;
  for (const TrafficShare& share : settings.shares) {
    json["shares"].push_back({{"version", share.version}, {"percent", share.percent}});
  }
  if (settings.shadow_version != 0) json["shadow_version"] = settings.shadow_version;
  if (settings.learning_paused) json["learning_paused"] = true;
  if (settings.rollout.has_value()) json["rollout"] = RolloutJson(*settings.rollout);
  return json;
}

}  // namespace

absl::Status ReadJson(absl::string_view field, const Json& json, TrafficShare* share) {
  JsonObject object(field, json);
  object.Required("version", &share->version, kFirstVersion);
  object.Required("percent", &share->percent, 0, 100);
  return object.Finish();
}

absl::Status ReadJson(absl::string_view field, const Json& json, PolicySettings* settings) {
  JsonObject object(field, json);
  object.Optional("default_version", &settings->default_version, kFirstVersion);
  object.Optional("default_follows_highest", &settings->default_follows_highest);
  object.Optional("shadow_version", &settings->shadow_version, kFirstVersion);
  object.Optional("learning_paused", &settings->learning_paused);
  object.Optional("labels", &settings->labels);
  object.Optional("shares", &settings->shares);
  object.Optional("rollout", &settings->rollout);
  RETURN_IF_ERROR(object.Finish());
  if (settings->default_follows_highest && settings->default_version != 0) {
    return absl::InvalidArgumentError(
        absl::StrCat(field, ".default_version: expected none beside default_follows_highest, ",
                     "received ", settings->default_version));
  }
  RETURN_IF_ERROR(CheckLabels(absl::StrCat(field, ".labels"), settings->labels));
  const auto shares = CheckShares(settings->shares);
  if (shares.ok()) return shares;
  return absl::InvalidArgumentError(absl::StrCat(field, ".", shares.message()));
}

std::string PolicySettings::DescribeUse(int64_t version) const {
  return version == default_version ? "the default" : DescribeUseBesideDefault(version);
}

std::string PolicySettings::DescribeUseBesideDefault(int64_t version) const {
  if (rollout_running() && (version == rollout->version || version == rollout->stable_version)) {
    return "part of a roll-out";
  }
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

absl::Status CheckNoRollout(const PolicySettings& settings) {
  if (!settings.rollout_running()) return absl::OkStatus();
  return absl::FailedPreconditionError(
      absl::StrCat("rollout: expected none that is running, received one of version ",
                   settings.rollout->version, "; abort it first"));
}

absl::Status ChooseDefault(int64_t version, PolicySettings* settings) {
  RETURN_IF_ERROR(CheckNoRollout(*settings));
  settings->default_version = version;
  settings->default_follows_highest = version == 0;
  return absl::OkStatus();
}

absl::Status CheckUnused(int64_t version, const std::string& use) {
  if (use.empty()) return absl::OkStatus();
  return absl::FailedPreconditionError(absl::StrCat(
      "version: expected one that no setting uses, received ", version, ", which is ", use));
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
  PolicySettings effective = settings;
  const auto waits = [&](const std::string& setting, int64_t version) {
    if (version == 0 || versions.contains(version)) return false;
    waiting->push_back(
        absl::StrCat(setting, ": waits for version ", version, ", which is not served"));
    return true;
  };
  if (waits("default_version", settings.default_version)) effective.default_version = 0;
  for (const auto& [label, version] : settings.labels) {
    if (waits(absl::StrCat("labels.", label), version)) effective.labels.erase(label);
  }
  for (const TrafficShare& share : settings.shares) {
    if (waits("shares", share.version)) effective.shares.clear();
  }
  if (waits("shadow_version", settings.shadow_version)) effective.shadow_version = 0;
  return effective;
}

absl::StatusOr<Settings> ParseSettings(absl::string_view text) {
  ASSIGN_OR_RETURN(const auto json, ParseJsonObject("settings", text));
  Settings settings;
  std::map<std::string, std::vector<int64_t>> unloaded;
  std::map<std::string, std::map<std::string, std::string>> promoted;
  JsonObject object("", json);
  object.Optional("policies", &settings.policies);
  object.Optional("unloaded", &unloaded);
  object.Optional("promoted", &promoted);
  object.Optional("holds", &settings.holds);
  RETURN_IF_ERROR(object.Finish());
  // As ToJson() does, so that equal settings compare equal.
  std::erase_if(settings.policies,
                [](const auto& policy) { return policy.second == PolicySettings(); });
  for (const auto& [name, versions] : unloaded) {
    for (const int64_t version : versions) {
      RETURN_IF_ERROR(CheckVersion(absl::StrCat("unloaded.", name), version));
      settings.unloaded.insert({.policy = name, .version = version});
    }
  }
  for (const auto& [name, versions] : promoted) {
    const std::string field = absl::StrCat("promoted.", name);
    for (const auto& [number, sha256] : versions) {
      const auto version = ParseVersion(number);
      if (!version.ok()) return Annotate(version.status(), field);
      settings.promoted[{.policy = name, .version = *version}] = sha256;
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
  for (const auto& [version, sha256] : settings.promoted) {
    json["promoted"][version.policy][absl::StrCat(version.version)] = sha256;
  }
  for (const SessionHold& hold : settings.holds) json["holds"].push_back(HoldJson(hold));
  return json.dump(2) + "\n";
}

absl::StatusOr<Settings> ReadSettings(const std::string& path) {
  std::error_code error;
  if (std::filesystem::symlink_status(path, error).type() ==
      std::filesystem::file_type::not_found) {
    return Settings();
  }
  ASSIGN_OR_RETURN(const auto text, ReadFile(path));
  auto settings = ParseSettings(text);
  if (settings.ok()) return settings;
  return Annotate(settings.status(), path);
}

absl::Status WriteSettings(const Settings& settings, const std::string& path) {
  const std::string text = ToJson(settings);
  return WriteFileAtomically(path, {text});
}

}  // namespace spikeserve
