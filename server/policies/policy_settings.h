// The settings of operators for policy versions, and the file that keeps them over a restart:
//
//   {"policies": {"cartpole": {"default_version": 1,
//                              "labels": {"stable": 1, "canary": 2},
//                              "shares": [{"version": 1, "percent": 95},
//                                         {"version": 2, "percent": 5}],
//                              "shadow_version": 3,
//                              "learning_paused": true},
//                 "pendulum": {"default_follows_highest": true}},
//    "unloaded": {"cartpole": [4]},
//    "promoted": {"cartpole": {"5": "<64 hexadecimal digits>"}},
//    "holds": [{"id": "fire-3", "reason": "smoke", "since": 1.7e9, "policy": "cartpole"}]}
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/base/enum_names.h"
#include "nlohmann/json.hpp"
#include "server/policies/policy_folder.h"
#include "server/policies/rollout.h"
#include "server/policies/session_holds.h"

namespace spikeserve {

// What the default version of a policy does, unless an operator sets it, when versions are loaded.
// It begins as the highest version.
enum class DefaultRule {
  kStay,     // stays the version that it is
  kHighest,  // is always the highest version
};

constexpr std::array<EnumName<DefaultRule>, 2> EnumNames(DefaultRule) {
  return {{{DefaultRule::kStay, "stay"}, {DefaultRule::kHighest, "highest"}}};
}

// The share of new sessions that a version gets.
struct TrafficShare {
  int64_t version = 0;
  int percent = 0;

  friend bool operator==(const TrafficShare&, const TrafficShare&) = default;
};
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, TrafficShare* share);

struct PolicySettings {
  int64_t default_version = 0;           // 0: not chosen yet, or the highest version
  bool default_follows_highest = false;  // then default_version is 0
  std::map<std::string, int64_t> labels = {};
  std::vector<TrafficShare> shares = {};  // sum to 100 %; empty: all to the default
  int64_t shadow_version = 0;             // 0: none
  bool learning_paused = false;
  std::optional<Rollout> rollout = {};  // the last one

  bool rollout_running() const { return rollout.has_value() && rollout->running(); }

  // Returns the first setting that uses `version`, such as "label stable"; empty if none does.
  std::string DescribeUse(int64_t version) const;
  // As DescribeUse, without the default.
  std::string DescribeUseBesideDefault(int64_t version) const;

  // Returns the share of `version` in percent; 0 if `shares` does not name it.
  int PercentOf(int64_t version) const;

  friend bool operator==(const PolicySettings&, const PolicySettings&) = default;
};
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json,
                      PolicySettings* settings);

struct Settings {
  std::map<std::string, PolicySettings> policies;
  // Not loaded until an operator loads them. Stored versions that were removed are here, too, so
  // that no server that has missed it serves them, and not `promoted`.
  std::set<PolicyVersion> unloaded;
  // The SHA-256 of the files of stored versions, which were promoted or pushed, in hexadecimal;
  // with shared settings only.
  std::map<PolicyVersion, std::string> promoted;
  SessionHolds::List holds;  // the oldest first
};

// Returns FAILED_PRECONDITION while a roll-out of the policy is running.
absl::Status CheckNoRollout(const PolicySettings& settings);

// Sets the default; 0: it follows the highest version. Returns the error of CheckNoRollout().
absl::Status ChooseDefault(int64_t version, PolicySettings* settings);

// Returns FAILED_PRECONDITION if a setting uses `version`, as DescribeUse() has described.
absl::Status CheckUnused(int64_t version, const std::string& use);

// Returns INVALID_ARGUMENT unless `shares` is empty, or every percent is in [0, 100], each version
// occurs once and the percents sum to 100.
absl::Status CheckShares(const std::vector<TrafficShare>& shares);

// Returns the part of `settings` that is in force while `versions` are served. A setting that names
// another version waits for it and adds a line to `waiting`. If one share waits, all shares wait.
PolicySettings EffectiveSettings(const PolicySettings& settings, const std::set<int64_t>& versions,
                                 std::vector<std::string>* waiting);

// Parses the text of a settings file. Returns INVALID_ARGUMENT, which names the field, the expected
// and the received value, for an unknown key or a value of another type. Does not check whether the
// versions are served.
absl::StatusOr<Settings> ParseSettings(absl::string_view text);

std::string ToJson(const Settings& settings);

// Reads a settings file. Returns empty settings if there is no such file. Errors name the path.
absl::StatusOr<Settings> ReadSettings(const std::string& path);

// Replaces the settings file atomically: readers find the old file or the new one. Errors name the
// path.
absl::Status WriteSettings(const Settings& settings, const std::string& path);

}  // namespace spikeserve
