#include <array>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/time/time.h"
#include "core/base/status_macros.h"
#include "proto/json.h"
#include "server/admin/admin_handler.h"
#include "server/admin/traffic.h"
#include "server/rollouts/evidence_total.h"
#include "server/rollouts/rollout_judge.h"

namespace spikeserve {
namespace {

constexpr double kP99 = 0.99;

constexpr std::array<std::pair<RolloutMeasure, v1::RolloutCondition::Measure>, 3> kMeasures = {
    {{RolloutMeasure::kReturn, v1::RolloutCondition::MEASURE_RETURN},
     {RolloutMeasure::kErrors, v1::RolloutCondition::MEASURE_ERRORS},
     {RolloutMeasure::kP99, v1::RolloutCondition::MEASURE_P99}}};

absl::StatusOr<RolloutMeasure> MeasureFromProto(v1::RolloutCondition::Measure proto) {
  for (const auto& [measure, known] : kMeasures) {
    if (known == proto) return measure;
  }
  return absl::InvalidArgumentError(
      absl::StrCat("abort_if.measure: expected MEASURE_RETURN, MEASURE_ERRORS or MEASURE_P99, ",
                   "received ", static_cast<int>(proto)));
}

v1::RolloutCondition::Measure ToProto(RolloutMeasure measure) {
  return kMeasures[static_cast<size_t>(measure)].second;
}

v1::Rollout::State ToProto(RolloutState state) {
  switch (state) {
    case RolloutState::kRunning:
      return v1::Rollout::STATE_RUNNING;
    case RolloutState::kCompleted:
      return v1::Rollout::STATE_COMPLETED;
    case RolloutState::kAborted:
      return v1::Rollout::STATE_ABORTED;
    case RolloutState::kCancelled:
      break;
  }
  return v1::Rollout::STATE_CANCELLED;
}

// Returns OK if an evaluation is of the files of both versions, can tell, and does not find the new
// one worse.
absl::Status CheckEvaluation(const v1::OfflineEvaluation& offline, const ServedPolicy& stable,
                             const ServedPolicy& fresh) {
  const auto refuse = [](absl::string_view field, absl::string_view expected, auto received) {
    return absl::FailedPreconditionError(absl::StrCat("offline_evaluation.", field, ": expected ",
                                                      expected, ", received ", received));
  };
  if (offline.recorded_sha256() != stable.sha256) {
    return refuse("recorded_sha256", absl::StrCat("that of the default version, ", stable.sha256),
                  offline.recorded_sha256());
  }
  if (offline.new_sha256() != fresh.sha256) {
    return refuse("new_sha256", absl::StrCat("that of the new version, ", fresh.sha256),
                  offline.new_sha256());
  }
  if (!offline.can_tell()) {
    return refuse("can_tell", "more episodes that are like the new version's",
                  absl::StrCat(offline.effective_episodes(), " effective ones, which cannot tell"));
  }
  if (offline.difference_high() >= 0.0) return absl::OkStatus();
  return refuse("difference_high", "at least 0: the new version is worse",
                offline.difference_high());
}

absl::StatusOr<Rollout> PlanFromProto(const v1::StartRolloutRequest& request) {
  Rollout plan;
  plan.version = request.version();
  plan.steps.assign(request.steps().begin(), request.steps().end());
  if (request.has_hold_seconds()) plan.hold_seconds = request.hold_seconds();
  if (request.has_min_episodes()) plan.min_episodes = request.min_episodes();
  for (const v1::RolloutCondition& condition : request.abort_if()) {
    ASSIGN_OR_RETURN(const auto measure, MeasureFromProto(condition.measure()));
    plan.abort_if.push_back({.measure = measure, .margin = condition.margin()});
  }
  if (request.has_offline_evaluation()) {
    plan.offline_evaluation = JsonText(MessageToFields(request.offline_evaluation()));
  }
  return plan;
}

void ToProto(const VersionEvidence::Counts& counts, v1::VersionEvidence* proto) {
  const EvidenceTotal total = TotalOf(counts);
  proto->set_sessions(total.sessions);
  proto->set_failed_sessions(total.failed_sessions);
  proto->set_episodes(total.episodes);
  proto->set_implausible_episodes(total.implausible);
  proto->set_mean_return(total.returns.mean);
  proto->set_return_deviation(std::sqrt(total.returns.variance));
  proto->set_decisions(total.durations.total());
  proto->set_p99_seconds(total.durations.Quantile(kP99));
}

// Returns what the running step waits for.
std::string WaitsFor(const RolloutManager::Progress& progress) {
  const Rollout& rollout = progress.rollout;
  std::vector<std::string> waits;
  const double seconds = rollout.hold_seconds - rollout.held_seconds;
  if (seconds > 0.0) {
    const auto left = absl::Seconds(static_cast<int64_t>(std::ceil(seconds)));
    waits.push_back(absl::FormatDuration(left));
  }
  const int64_t episodes = rollout.min_episodes + rollout.episodes_at_step -
                           TotalOf(progress.new_version).capped_episodes;
  if (episodes > 0) {
    waits.push_back(absl::StrCat(episodes, " more episodes of version ", rollout.version,
                                 ", at most ", rollout.most_episodes_per_session(),
                                 " of one session"));
  }
  if (rollout.enters_all()) {
    const Shortfall missing =
        ShortfallOf(rollout.abort_if, progress.new_version, progress.stable_version);
    if (!missing.none()) {
      waits.push_back(absl::StrCat("a comparison: ", missing.new_version,
                                   " more sessions of version ", rollout.version, " and ",
                                   missing.stable_version, " of version ", rollout.stable_version));
    }
  }
  if (!rollout.disputed.empty()) {
    waits.push_back(absl::StrCat("the end of a dispute (", rollout.disputed, ")"));
  }
  return waits.empty() ? "the step ends" : "waits for " + absl::StrJoin(waits, " and ");
}

void ToProto(const std::string& policy, const RolloutManager::Progress& progress,
             v1::Rollout* proto) {
  const Rollout& rollout = progress.rollout;
  proto->set_policy(policy);
  proto->set_version(rollout.version);
  proto->set_stable_version(rollout.stable_version);
  proto->set_state(ToProto(rollout.state));
  proto->mutable_steps()->Add(rollout.steps.begin(), rollout.steps.end());
  proto->set_step(static_cast<int32_t>(rollout.step));
  proto->set_percent(rollout.percent());
  proto->set_hold_seconds(rollout.hold_seconds);
  proto->set_min_episodes(rollout.min_episodes);
  for (const RolloutCondition& condition : rollout.abort_if) {
    auto* added = proto->add_abort_if();
    added->set_measure(ToProto(condition.measure));
    added->set_margin(condition.margin);
  }
  proto->set_reason(rollout.running() ? WaitsFor(progress) : rollout.reason);
  proto->set_disputed(!rollout.disputed.empty());
  proto->set_started(rollout.started);
  proto->set_step_started(rollout.step_started);
  proto->set_ended(rollout.ended);
  if (!rollout.offline_evaluation.empty() &&
      !JsonToMessage(rollout.offline_evaluation, proto->mutable_offline_evaluation()).ok()) {
    proto->clear_offline_evaluation();  // edited by hand in the settings
  }
  ToProto(progress.new_version, proto->mutable_new_version_evidence());
  ToProto(progress.stable_version, proto->mutable_stable_version_evidence());
}

}  // namespace

void AdminHandler::Describe(const std::string& policy, v1::Rollout* rollout) const {
  const auto list = parts_.rollouts->List();
  if (const auto found = list.find(policy); found != list.end()) {
    ToProto(policy, found->second, rollout);
  }
}

absl::Status AdminHandler::StartRollout(CallContext& /*context*/,
                                        const v1::StartRolloutRequest& request,
                                        v1::StartRolloutResponse* response) const {
  ASSIGN_OR_RETURN(const auto plan, PlanFromProto(request));
  if (parts_.files != nullptr) {
    RETURN_IF_ERROR(parts_.files->CheckServedByAll({request.policy(), request.version()}));
    if (const auto stable = parts_.registry->catalog()->Find(request.policy(), /*version=*/0);
        stable.ok()) {
      RETURN_IF_ERROR(parts_.files->CheckServedByAll({request.policy(), (*stable)->version}));
    }
  }
  const auto check = [&](const ServedPolicy& stable, const ServedPolicy& fresh) {
    return request.has_offline_evaluation()
               ? CheckEvaluation(request.offline_evaluation(), stable, fresh)
               : absl::OkStatus();
  };
  auto status = ChangeTraffic(*parts_.registry, request.policy(), response->mutable_traffic(), [&] {
    return parts_.rollouts->Start(request.policy(), plan, check);
  });
  Describe(request.policy(), response->mutable_rollout());
  return status;
}

absl::Status AdminHandler::AbortRollout(CallContext& /*context*/,
                                        const v1::AbortRolloutRequest& request,
                                        v1::AbortRolloutResponse* response) const {
  auto status = ChangeTraffic(*parts_.registry, request.policy(), response->mutable_traffic(),
                              [&] { return parts_.rollouts->Cancel(request.policy()); });
  Describe(request.policy(), response->mutable_rollout());
  return status;
}

absl::Status AdminHandler::ListRollouts(CallContext& /*context*/,
                                        const v1::ListRolloutsRequest& /*request*/,
                                        v1::ListRolloutsResponse* response) const {
  for (const auto& [policy, progress] : parts_.rollouts->List()) {
    ToProto(policy, progress, response->add_rollouts());
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
