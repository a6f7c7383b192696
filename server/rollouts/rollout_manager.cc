#include "server/rollouts/rollout_manager.h"

#include <algorithm>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"
#include "server/rollouts/evidence_total.h"
#include "server/rollouts/rollout_judge.h"

namespace spikeserve {
namespace {

// The interval at which the evidence of a running roll-out is saved. A crash loses at most this
// much of it.
constexpr absl::Duration kSaveInterval = absl::Seconds(5);

double UnixSeconds() { return absl::ToDoubleSeconds(absl::Now() - absl::UnixEpoch()); }

// The new version comes first, so that a growing share keeps the routing keys that it had.
std::vector<TrafficShare> SharesOf(const Rollout& rollout) {
  std::vector<TrafficShare> shares = {{.version = rollout.version, .percent = rollout.percent()}};
  if (rollout.percent() < 100) {
    shares.push_back({.version = rollout.stable_version, .percent = 100 - rollout.percent()});
  }
  return shares;
}

VersionEvidence::Counts CountsOf(const EvidenceByTenant& kept) {
  VersionEvidence::Counts counts;
  for (const auto& [tenant, of] : kept) counts[tenant] = {of, {}};
  return counts;
}

EvidenceByTenant EvidenceOf(const VersionEvidence::Counts& counts) {
  return EvidenceByTenant(counts.begin(), counts.end());  // without the durations
}

int64_t CappedEpisodes(const VersionEvidence::Counts& counts) {
  return TotalOf(counts).capped_episodes;
}

absl::Status CheckStart(const CatalogPolicy& policy, const PolicySettings& settings,
                        const Rollout& plan) {
  if (settings.rollout_running()) {
    return absl::FailedPreconditionError(
        absl::StrCat("rollout: expected none that is running, received one of version ",
                     settings.rollout->version));
  }
  if (!settings.shares.empty()) {
    return absl::FailedPreconditionError(
        absl::StrCat("shares: expected none, because a roll-out sets them, received shares of ",
                     settings.shares.size(), " versions; remove them first"));
  }
  const auto next = policy.versions.find(plan.version);
  if (next == policy.versions.end()) {
    return absl::NotFoundError(
        absl::StrCat("version: expected a served version, received ", plan.version));
  }
  if (plan.version == policy.DefaultVersion()) {
    return InvalidArgument("version", "one that is not the default", plan.version);
  }
  if (SameSpaces(*next->second, *policy.versions.at(policy.DefaultVersion()))) {
    return absl::OkStatus();
  }
  return absl::FailedPreconditionError(
      absl::StrCat("version: expected the observations and actions of version ",
                   policy.DefaultVersion(), ", the default, received version ", plan.version));
}

}  // namespace

RolloutManager::RolloutManager(PolicyRegistry* registry, Metrics* metrics, const Clock* clock,
                               const LiveServers* replicas,
                               std::function<void(const Change&)> changed)
    : registry_(registry),
      metrics_(metrics),
      clock_(clock),
      replicas_(replicas),
      changed_(std::move(changed)) {
  absl::MutexLock lock(&mutex_);
  const auto catalog = registry_->catalog();
  for (const auto& [name, policy] : catalog->policies()) {
    const std::optional<Rollout>& rollout = policy.settings.rollout;
    const bool running = policy.settings.rollout_running();
    if (running && replicas_->IsMine(rollout->replica)) TakeOver(name, policy);
  }
}

void RolloutManager::TakeOver(const std::string& policy, const CatalogPolicy& served) {
  const Rollout& rollout = *served.settings.rollout;
  Watch(policy, served, rollout);
  const absl::Duration now = clock_->Now();
  running_[policy] = {.ticked = now,
                      .saved = now,
                      .step = rollout.step,
                      .held_seconds = rollout.held_seconds,
                      .disputed = rollout.disputed};
}

void RolloutManager::Watch(const std::string& policy, const CatalogPolicy& served,
                           const Rollout& rollout) {
  const auto watch = [&](int64_t version, const EvidenceByTenant& evidence) {
    const auto found = served.versions.find(version);
    const PlausibleReturns plausible = found == served.versions.end()
                                           ? PlausibleReturns()
                                           : PlausibleReturns::Of(found->second->policy());
    metrics_->EvidenceOf(policy, version)
        ->Watch(CountsOf(evidence), rollout.most_episodes_per_session(), plausible);
  };
  watch(rollout.version, rollout.new_evidence);
  watch(rollout.stable_version, rollout.stable_evidence);
}

void RolloutManager::Stop(const std::string& policy, const Rollout& rollout) {
  metrics_->EvidenceOf(policy, rollout.version)->Stop();
  metrics_->EvidenceOf(policy, rollout.stable_version)->Stop();
}

RolloutManager::Progress RolloutManager::ProgressOf(const std::string& policy,
                                                    const Rollout& rollout) const {
  if (!rollout.running() || !running_.contains(policy)) {
    return {rollout, CountsOf(rollout.new_evidence), CountsOf(rollout.stable_evidence)};
  }
  return {rollout, metrics_->EvidenceOf(policy, rollout.version)->Read(),
          metrics_->EvidenceOf(policy, rollout.stable_version)->Read()};
}

absl::Status RolloutManager::Start(const std::string& policy, Rollout plan, const Check& check) {
  absl::MutexLock lock(&mutex_);
  if (plan.steps.empty()) plan.steps = {1, 10, 50, 100};
  if (plan.abort_if.empty()) plan.abort_if = DefaultConditions();
  RETURN_IF_ERROR(plan.Validate());
  if (plan.steps.front() == 100) {
    return InvalidArgument(
        "steps", "a first step below 100, because the sessions of both versions are compared",
        "100; admin default moves all at once");
  }
  const auto change = [&](const CatalogPolicy& served, PolicySettings* settings) {
    RETURN_IF_ERROR(CheckStart(served, *settings, plan));
    if (check != nullptr) {
      RETURN_IF_ERROR(
          check(*served.versions.at(served.DefaultVersion()), *served.versions.at(plan.version)));
    }
    plan.stable_version = served.DefaultVersion();
    plan.started = plan.step_started = UnixSeconds();
    Watch(policy, served, plan);
    settings->default_version = plan.stable_version;
    settings->default_follows_highest = false;
    settings->shares = SharesOf(plan);
    plan.replica = replicas_->self();
    settings->rollout = plan;
    return absl::OkStatus();
  };
  auto status = registry_->Change(policy, change);
  if (status.ok()) running_[policy] = {.ticked = clock_->Now(), .saved = clock_->Now()};
  return status;
}

absl::Status RolloutManager::Cancel(const std::string& policy) {
  absl::MutexLock lock(&mutex_);
  return End(policy, RolloutState::kCancelled, "an operator ended it");
}

std::map<std::string, RolloutManager::Progress> RolloutManager::List() const {
  absl::MutexLock lock(&mutex_);
  std::map<std::string, Progress> list;
  const auto catalog = registry_->catalog();
  for (const auto& [name, policy] : catalog->policies()) {
    if (!policy.settings.rollout.has_value()) continue;
    Progress progress = ProgressOf(name, *policy.settings.rollout);
    const auto running = running_.find(name);
    if (progress.rollout.running() && running != running_.end()) {
      progress.rollout.held_seconds = running->second.held_seconds;
    }
    list.emplace(name, std::move(progress));
  }
  return list;
}

void RolloutManager::SaveEvidence() {
  absl::MutexLock lock(&mutex_);
  const auto catalog = registry_->catalog();
  for (const auto& [name, policy] : catalog->policies()) {
    if (policy.settings.rollout_running() && running_.contains(name)) {
      SaveOrLog(name);
    }
  }
}

void RolloutManager::SaveOrLog(const std::string& policy) {
  const auto status = Save(policy, [](Rollout*, PolicySettings*) {});
  if (!status.ok()) LogError("roll-out not saved", {{"error", status.message()}});
}

void RolloutManager::Tick() {
  absl::MutexLock lock(&mutex_);
  const auto catalog = registry_->catalog();
  for (const auto& [name, policy] : catalog->policies()) {
    const std::optional<Rollout>& rollout = policy.settings.rollout;
    const bool running = policy.settings.rollout_running();
    if (running && replicas_->IsMine(rollout->replica)) {
      if (!running_.contains(name)) TakeOver(name, policy);
      TickOne(name, policy);
    } else if (running_.erase(name) > 0 && rollout.has_value()) {
      Stop(name, *rollout);
    }
  }
}

void RolloutManager::TickOne(const std::string& policy, const CatalogPolicy& catalog_policy) {
  Progress progress = ProgressOf(policy, *catalog_policy.settings.rollout);
  Running& running = running_[policy];
  const absl::Duration now = clock_->Now();
  running.held_seconds += absl::ToDoubleSeconds(now - std::exchange(running.ticked, now));
  HoldStep(policy, progress.rollout.version, progress.rollout.step);
  const std::string worse = FindAbort(policy, catalog_policy, progress);
  if (!worse.empty()) {
    SaveAndReport("AbortRollout", policy, worse, [&] {
      mutex_.AssertHeld();
      return End(policy, RolloutState::kAborted, worse);
    });
  } else if (MayAdvance(policy, progress)) {
    Advance(policy, progress);
  } else if (now - running.saved >= kSaveInterval) {
    running.saved = now;
    SaveOrLog(policy);
  }
}

bool RolloutManager::MayAdvance(const std::string& policy, const Progress& progress) const {
  const Rollout& rollout = progress.rollout;
  const Running& running = running_.at(policy);
  if (!running.disputed.empty() || running.held_seconds < rollout.hold_seconds) return false;
  const int64_t episodes = CappedEpisodes(progress.new_version) - rollout.episodes_at_step;
  if (episodes < rollout.min_episodes) return false;
  // Where all get the new version, nothing is left to compare it with.
  return !rollout.enters_all() ||
         ShortfallOf(rollout.abort_if, progress.new_version, progress.stable_version).none();
}

std::string RolloutManager::FindAbort(const std::string& policy, const CatalogPolicy& served,
                                      const Progress& progress) {
  const Rollout& rollout = progress.rollout;
  for (const int64_t version : {rollout.version, rollout.stable_version}) {
    if (!served.versions.contains(version)) {
      return absl::StrCat("version ", version, " is not served any more");
    }
  }
  Running& running = running_[policy];
  const Policy& stable = served.versions.at(rollout.stable_version)->policy();
  const RolloutVerdict verdict =
      JudgeRollout(rollout.abort_if, progress.new_version, progress.stable_version,
                   PlausibleReturns::Of(stable).TrainedRange());
  const bool is_disputed = verdict.kind == RolloutVerdict::Kind::kDisputed;
  if (verdict.kind == RolloutVerdict::Kind::kWorse) return verdict.reason;
  const absl::Duration now = clock_->Now();
  if (!is_disputed || verdict.contradicted) {
    running.uncontradicted_since.reset();
  } else if (!running.uncontradicted_since.has_value()) {
    running.uncontradicted_since = now;
  } else if (now - *running.uncontradicted_since >= absl::Seconds(rollout.hold_seconds)) {
    return absl::StrCat(verdict.reason, "; no others have enough sessions to contradict it");
  }
  const bool has_changed = is_disputed == running.disputed.empty();
  running.disputed = verdict.reason;
  if (has_changed) {
    // The answers to operators do not name tenants, whom they may not see.
    LogWarning(is_disputed ? "roll-out disputed" : "roll-out not disputed any more",
               {{"policy", policy}, {"tenant", verdict.tenant}, {"reason", verdict.reason}});
  }
  if (is_disputed && rollout.step > 0) {  // until that is written
    GoBack(policy, progress);
  } else if (has_changed) {
    SaveOrLog(policy);
  }
  return "";
}

void RolloutManager::GoBack(const std::string& policy, const Progress& progress) {
  const Rollout& rollout = progress.rollout;
  const std::string reason =
      absl::StrCat("disputed: from ", rollout.percent(), " % to ", rollout.steps.front(),
                   " % of the new sessions; ", running_[policy].disputed);
  SaveAndReport("ReturnRollout", policy, reason, [&] {
    mutex_.AssertHeld();
    return EnterStep(policy, progress, /*step=*/0);
  });
}

absl::Status RolloutManager::EnterStep(const std::string& policy, const Progress& progress,
                                       int64_t step) {
  RETURN_IF_ERROR(Save(policy, [&](Rollout* changed, PolicySettings* settings) {
    changed->held_seconds = 0.0;
    changed->step = step;
    changed->step_started = UnixSeconds();
    changed->episodes_at_step = CappedEpisodes(progress.new_version);
    settings->shares = SharesOf(*changed);
  }));
  HoldStep(policy, progress.rollout.version, step);
  return absl::OkStatus();
}

void RolloutManager::HoldStep(const std::string& policy, int64_t version, int64_t step) {
  Running& running = running_[policy];
  if (std::exchange(running.step, step) == step) return;
  running.held_seconds = 0.0;
  metrics_->EvidenceOf(policy, version)->NextStep();
}

void RolloutManager::Advance(const std::string& policy, const Progress& progress) {
  const Rollout& rollout = progress.rollout;
  if (rollout.step + 1 < std::ssize(rollout.steps)) {
    const int next = rollout.steps[static_cast<size_t>(rollout.step) + 1];
    const std::string reason =
        absl::StrCat("from ", rollout.percent(), " % to ", next, " % of the new sessions");
    return SaveAndReport("AdvanceRollout", policy, reason, [&] {
      mutex_.AssertHeld();
      return EnterStep(policy, progress, rollout.step + 1);
    });
  }
  SaveAndReport("CompleteRollout", policy, "every step was held", [&] {
    mutex_.AssertHeld();
    auto status = Save(policy, [&](Rollout* changed, PolicySettings* settings) {
      changed->state = RolloutState::kCompleted;
      changed->ended = UnixSeconds();
      changed->reason = "every step was held";
      if (changed->percent() < 100) return;
      settings->default_version = changed->version;
      settings->shares.clear();
    });
    if (status.ok()) Stop(policy, rollout);
    return status;
  });
}

absl::Status RolloutManager::End(const std::string& policy, RolloutState state,
                                 const std::string& reason) {
  std::optional<Rollout> ended;
  auto status = Save(policy, [&](Rollout* changed, PolicySettings* settings) {
    changed->state = state;
    changed->ended = UnixSeconds();
    changed->reason = reason;
    changed->disputed.clear();
    settings->shares.clear();
    ended = *changed;
  });
  if (status.ok()) Stop(policy, *ended);
  return status;
}

absl::Status RolloutManager::Save(const std::string& policy,
                                  absl::FunctionRef<void(Rollout*, PolicySettings*)> change) {
  return registry_->Change(policy, [&](const CatalogPolicy& /*served*/, PolicySettings* settings) {
    mutex_.AssertHeld();
    if (!settings->rollout_running()) {
      return absl::FailedPreconditionError(
          absl::StrCat("rollout: expected one that is running, received none of policy ", policy));
    }
    Rollout& rollout = *settings->rollout;
    if (const auto running = running_.find(policy); running != running_.end()) {
      const Progress progress = ProgressOf(policy, rollout);
      rollout.new_evidence = EvidenceOf(progress.new_version);
      rollout.stable_evidence = EvidenceOf(progress.stable_version);
      rollout.held_seconds = running->second.held_seconds;
      rollout.disputed = running->second.disputed;
      rollout.replica = replicas_->self();
    }
    change(&rollout, settings);
    return absl::OkStatus();
  });
}

void RolloutManager::SaveAndReport(const std::string& action, const std::string& policy,
                                   const std::string& reason,
                                   absl::FunctionRef<absl::Status()> save) {
  const auto before = registry_->catalog();
  if (auto status = save(); !status.ok()) {
    return LogError("roll-out not changed",
                    {{"policy", policy}, {"action", action}, {"error", status.message()}});
  }
  changed_({.action = action,
            .policy = policy,
            .reason = reason,
            .before = before,
            .after = registry_->catalog()});
}

}  // namespace spikeserve
