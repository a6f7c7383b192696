#include "client/spikectl/traffic_report.h"

#include <map>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "proto/json.h"

namespace spikeserve {
namespace {

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

}  // namespace

ServerAnswer TrafficAnswer(std::string text, nlohmann::ordered_json json,
                           const v1::TrafficChange& traffic) {
  absl::StrAppend(&text, "\n  before: ", ToText(traffic.before()),
                  "\n  after:  ", ToText(traffic.after()));
  json["before"] = MessageToFields(traffic.before(), Numbers::kExact);
  json["after"] = MessageToFields(traffic.after(), Numbers::kExact);
  return {std::move(text), std::move(json), traffic.shared()};
}

}  // namespace spikeserve
