// What an operator has set about policies' versions, and the file that keeps it over a restart:
//
//   {"policies": {"cartpole": {"default_version": 1,
//                              "labels": {"stable": 1, "canary": 2},
//                              "shares": [{"version": 1, "percent": 95},
//                                         {"version": 2, "percent": 5}],
//                              "shadow_version": 3,
//                              "learning_paused": true}},
//    "unloaded": {"cartpole": [4]}}
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_POLICIES_POLICY_SETTINGS_H_
#define SERVER_POLICIES_POLICY_SETTINGS_H_

#include <cstdint>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "nlohmann/json.hpp"
#include "server/policies/policy_repository.h"

namespace spikeserve {

// A version's part of the new sessions.
struct TrafficShare {
  int64_t version = 0;
  int percent = 0;

  friend bool operator==(const TrafficShare&, const TrafficShare&) = default;
};
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, TrafficShare* share);

struct PolicySettings {
  int64_t default_version = 0;  // 0: the highest
  std::map<std::string, int64_t> labels = {};
  std::vector<TrafficShare> shares = {};  // add up to 100; empty: all to the default
  int64_t shadow_version = 0;             // 0: none
  bool learning_paused = false;

  // What is set to this version, such as "label stable"; empty where nothing is.
  std::string UseOf(int64_t version) const;

  // Of the new sessions, where there are shares.
  int PercentOf(int64_t version) const;

  friend bool operator==(const PolicySettings&, const PolicySettings&) = default;
};
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json,
                      PolicySettings* settings);

struct Settings {
  std::map<std::string, PolicySettings> policies;
  std::set<PolicyVersion> unloaded;  // kept out until an operator loads them
};

// INVALID_ARGUMENT unless there are none, or every percent is in [0, 100], no version comes twice
// and they add up to 100.
absl::Status CheckShares(const std::vector<TrafficShare>& shares);

// The part of `settings` that holds while these versions are served. What names another one waits
// for it, and gets a line in `waiting`: shares wait together, everything else by itself.
PolicySettings EffectiveSettings(const PolicySettings& settings, const std::set<int64_t>& versions,
                                 std::vector<std::string>* waiting);

// Nothing is guessed: an unknown key or a value of another type is INVALID_ARGUMENT, which names
// the field, what was expected and what came. Whether the versions are served is not looked at.
absl::StatusOr<Settings> ParseSettings(absl::string_view text);

std::string ToJson(const Settings& settings);

// Nothing where there is no such file. Errors name the path.
absl::StatusOr<Settings> ReadSettings(const std::string& path);

// A reader meets the old file or the new one. Errors name the path.
absl::Status WriteSettings(const Settings& settings, const std::string& path);

}  // namespace spikeserve

#endif  // SERVER_POLICIES_POLICY_SETTINGS_H_
