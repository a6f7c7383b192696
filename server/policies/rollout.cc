#include "server/policies/rollout.h"

#include <algorithm>
#include <cmath>
#include <set>
#include <utility>

#include "absl/algorithm/container.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/json_object.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

Json EvidenceJson(const EvidenceByTenant& evidence) {
  Json tenants = Json::object();
  for (const auto& [tenant, counts] : evidence) {
    Json& json = tenants[tenant] = {{"sessions", counts.sessions},
                                    {"failed_sessions", counts.failed_sessions},
                                    {"episodes", counts.episodes},
                                    {"implausible_episodes", counts.implausible},
                                    {"capped_episodes", counts.capped_episodes},
                                    {"returning_sessions", counts.returning},
                                    {"session_episodes", Json::array()},
                                    {"session_returns", Json::array()}};
    for (const SessionReturn& session : counts.returns) {
      json["session_episodes"].push_back(session.episodes);
      json["session_returns"].push_back(session.mean);
    }
  }
  return {{"tenants", std::move(tenants)}};
}

// Reads the evidence of a version. That of an older server, which is not divided by sessions, reads
// as none: the comparison begins anew.
absl::Status ReadEvidence(absl::string_view field, const Json& json, EvidenceByTenant* evidence) {
  if (json.is_object() && json.contains("return_squares")) return absl::OkStatus();
  JsonObject object(field, json);
  object.Required("tenants", evidence);
  return object.Finish();
}

absl::Status CheckSteps(const std::vector<int>& steps) {
  const bool in_range = std::all_of(steps.begin(), steps.end(),
                                    [](int percent) { return percent >= 1 && percent <= 100; });
  const bool ascending =
      std::adjacent_find(steps.begin(), steps.end(), std::greater_equal<>()) == steps.end();
  if (!steps.empty() && in_range && ascending) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("steps: expected ascending percentages in [1, 100], received ",
                   steps.empty() ? "none" : absl::StrJoin(steps, ",")));
}

}  // namespace

absl::Status ReadJson(absl::string_view field, const Json& json, RolloutCondition* condition) {
  JsonObject object(field, json);
  object.Required("measure", &condition->measure);
  object.Required("margin", &condition->margin);
  return object.Finish();
}

absl::Status ReadJson(absl::string_view field, const Json& json, TenantEvidence* evidence) {
  JsonObject object(field, json);
  object.Required("sessions", &evidence->sessions, 0);
  object.Required("failed_sessions", &evidence->failed_sessions, 0);
  object.Required("episodes", &evidence->episodes, 0);
  object.Required("implausible_episodes", &evidence->implausible, 0);
  object.Required("capped_episodes", &evidence->capped_episodes, 0);
  object.Required("returning_sessions", &evidence->returning, 0);
  std::vector<int64_t> episodes;
  std::vector<double> returns;
  object.Required("session_episodes", &episodes);
  object.Required("session_returns", &returns);
  RETURN_IF_ERROR(object.Finish());
  const size_t sampled = returns.size();
  for (size_t i = 0; i < std::min(sampled, episodes.size()); ++i) {
    evidence->returns.push_back({.episodes = episodes[i], .mean = returns[i]});
  }
  const bool fits = episodes.size() == sampled &&
                    static_cast<int64_t>(sampled) <= evidence->returning &&
                    absl::c_all_of(evidence->returns, [](const SessionReturn& session) {
                      return session.episodes > 0 && std::isfinite(session.mean);
                    });
  if (fits) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat(field, ".session_returns: expected a finite number and its episodes of at most ",
                   evidence->returning, " sessions, received ", sampled, " and ", episodes.size()));
}

absl::Status Rollout::Validate() const {
  RETURN_IF_ERROR(CheckSteps(steps));
  if (!std::isfinite(hold_seconds) || hold_seconds <= 0.0) {
    return absl::InvalidArgumentError(
        absl::StrCat("hold_seconds: expected a number above 0, received ", hold_seconds));
  }
  if (min_episodes < 0) {
    return absl::InvalidArgumentError(
        absl::StrCat("min_episodes: expected at least 0, received ", min_episodes));
  }
  if (step < 0 || step >= std::ssize(steps)) {
    return absl::InvalidArgumentError(
        absl::StrCat("step: expected an index of steps, received ", step));
  }
  std::set<RolloutMeasure> seen;
  for (const RolloutCondition& condition : abort_if) {
    const absl::string_view measure = ToString(condition.measure);
    if (!seen.insert(condition.measure).second) {
      return absl::InvalidArgumentError(
          absl::StrCat("abort_if: expected each measure once, received ", measure, " twice"));
    }
    if (!std::isfinite(condition.margin) || condition.margin < 0.0) {
      return absl::InvalidArgumentError(absl::StrCat(
          "abort_if.", measure, ": expected a margin of at least 0, received ", condition.margin));
    }
  }
  return absl::OkStatus();
}

Json RolloutJson(const Rollout& rollout) {
  Json json = {{"version", rollout.version},
               {"stable_version", rollout.stable_version},
               {"steps", rollout.steps},
               {"hold_seconds", rollout.hold_seconds},
               {"min_episodes", rollout.min_episodes},
               {"abort_if", Json::array()},
               {"state", std::string(ToString(rollout.state))},
               {"step", rollout.step},
               {"held_seconds", rollout.held_seconds},
               {"episodes_at_step", rollout.episodes_at_step},
               {"started", rollout.started},
               {"step_started", rollout.step_started},
               {"ended", rollout.ended},
               {"reason", rollout.reason},
               {"replica", rollout.replica},
               {"new_evidence", EvidenceJson(rollout.new_evidence)},
               {"stable_evidence", EvidenceJson(rollout.stable_evidence)}};
  if (!rollout.disputed.empty()) json["disputed"] = rollout.disputed;
  if (!rollout.offline_evaluation.empty()) {
    json["offline_evaluation"] = rollout.offline_evaluation;
  }
  for (const RolloutCondition& condition : rollout.abort_if) {
    json["abort_if"].push_back(
        {{"measure", std::string(ToString(condition.measure))}, {"margin", condition.margin}});
  }
  return json;
}

absl::Status ReadJson(absl::string_view field, const Json& json, Rollout* rollout) {
  JsonObject object(field, json);
  object.Required("version", &rollout->version, kFirstVersion);
  object.Required("stable_version", &rollout->stable_version, kFirstVersion);
  object.Required("steps", &rollout->steps);
  object.Required("hold_seconds", &rollout->hold_seconds);
  object.Required("min_episodes", &rollout->min_episodes);
  object.Required("abort_if", &rollout->abort_if);
  object.Required("state", &rollout->state);
  object.Required("step", &rollout->step);
  object.Required("held_seconds", &rollout->held_seconds);
  object.Required("episodes_at_step", &rollout->episodes_at_step);
  object.Required("started", &rollout->started);
  object.Required("step_started", &rollout->step_started);
  object.Required("ended", &rollout->ended);
  object.Required("reason", &rollout->reason);
  object.Optional("replica", &rollout->replica);
  object.Optional("disputed", &rollout->disputed);
  object.Optional("offline_evaluation", &rollout->offline_evaluation);
  Json new_evidence;
  Json stable_evidence;
  object.Required("new_evidence", &new_evidence);
  object.Required("stable_evidence", &stable_evidence);
  RETURN_IF_ERROR(object.Finish());
  const std::string prefix = absl::StrCat(field, field.empty() ? "" : ".");
  auto status = ReadEvidence(prefix + "new_evidence", new_evidence, &rollout->new_evidence);
  status.Update(
      ReadEvidence(prefix + "stable_evidence", stable_evidence, &rollout->stable_evidence));
  if (!status.ok()) return status;
  if (rollout->new_evidence.empty()) rollout->episodes_at_step = 0;
  const auto valid = rollout->Validate();
  if (valid.ok()) return valid;
  return absl::InvalidArgumentError(absl::StrCat(field, ".", valid.message()));
}

}  // namespace spikeserve
