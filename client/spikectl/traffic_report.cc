#include "client/spikectl/traffic_report.h"

#include <map>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

std::map<std::string, int64_t> LabelsOf(const v1::Traffic& traffic) {
  return {traffic.labels().begin(), traffic.labels().end()};
}

std::string ToText(const v1::Traffic& traffic) {
  if (traffic.versions().empty()) return "not served";
  std::vector<std::string> parts = {
      absl::StrCat("versions ", absl::StrJoin(traffic.versions(), ", ")),
      absl::StrCat("default ", traffic.default_version(),
                   traffic.default_follows_highest() ? " (the highest)" : "")};
  if (traffic.shares().empty()) {
    parts.emplace_back("no shares");
  } else {
    parts.push_back("shares " +
                    absl::StrJoin(traffic.shares(), ", ", [](std::string* out, const auto& share) {
                      absl::StrAppend(out, share.version(), ":", share.percent());
                    }));
  }
  parts.push_back(traffic.shadow_version() == 0
                      ? "no shadow"
                      : absl::StrCat("shadow ", traffic.shadow_version()));
  parts.push_back(traffic.labels().empty() ? "no labels"
                                           : "labels " + absl::StrJoin(LabelsOf(traffic), ", ",
                                                                       absl::PairFormatter("=")));
  if (traffic.rollout_version() != 0) {
    parts.push_back(absl::StrCat("roll-out of ", traffic.rollout_version()));
  }
  return absl::StrJoin(parts, "; ");
}

ordered_json ToJson(const v1::Traffic& traffic) {
  ordered_json json = {{"versions", traffic.versions()},
                       {"default_version", traffic.default_version()},
                       {"default_follows_highest", traffic.default_follows_highest()},
                       {"labels", LabelsOf(traffic)},
                       {"shares", ordered_json::array()},
                       {"shadow_version", traffic.shadow_version()},
                       {"rollout_version", traffic.rollout_version()}};
  for (const v1::TrafficShare& share : traffic.shares()) {
    json["shares"].push_back({{"version", share.version()}, {"percent", share.percent()}});
  }
  return json;
}

}  // namespace

std::string ToText(const v1::TrafficChange& change) {
  return absl::StrCat("\n  before: ", ToText(change.before()),
                      "\n  after:  ", ToText(change.after()));
}

void AddTraffic(const v1::TrafficChange& change, ordered_json* json) {
  (*json)["before"] = ToJson(change.before());
  (*json)["after"] = ToJson(change.after());
}

}  // namespace spikeserve
