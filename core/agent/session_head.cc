#include "core/agent/session_head.h"

#include <string>
#include <utility>
#include <vector>

#include "absl/time/clock.h"
#include "absl/time/time.h"
#include "core/contract/dcheck.h"
#include "core/learning/frobenius_norm.h"
#include "core/learning/learner.h"
#include "core/math/counter_random.h"
#include "core/math/vector_view.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

// Other servers, which go on with the session, know this time, too.
double SecondsSince1970() { return absl::ToDoubleSeconds(absl::Now() - absl::UnixEpoch()); }

}  // namespace

SessionHead::SessionHead(std::shared_ptr<const ServedPolicy> served, Session* session)
    : served_(std::move(served)) {
  const Policy& policy = served_->policy();
  const SessionOptions& options = session->options;
  if (options.learning.has_value() && !session->learner.has_value()) {
    Eigen::VectorXf delta = options.head_delta;
    if (delta.size() == 0) delta.setZero(AsVector(policy.weights.head.weight.values).size());
    session->learner = Learner::New(*options.learning, policy, std::move(delta));
  }
  if (options.learning.has_value() && options.learning->scope == Scope::kFleet) {
    const bool by_tenant = served_->share_heads && !options.tenant.empty();
    member_ = std::make_unique<FleetHead::Member>(
        served_->HeadOf(options.tenant), by_tenant ? options.tenant : session->id, session->id);
    if (served_->log == nullptr) session->pending = nullptr;
    NewContribution(*session);
    return;
  }
  const Eigen::VectorXf delta = Delta(*session);
  if (delta.size() > 0) private_head_ = HeadWith(policy, delta);
}

void SessionHead::Choose(const Session& session, absl::Span<const float> readout,
                         ActionChoice* choice) const {
  const ActionSelection& selection = session.options.action_selection;
  // A greedy choice reads no random number.
  const uint64_t random =
      selection.sample ? RandomBits({session.options.seed, session.decisions}) : 0;
  const auto choose = [&](const Linear& head) {
    ChooseAction(head, served_->policy().action_space, readout, selection, random, choice);
  };
  if (IsInFleet()) return choose(member_->head().Read()->head);
  choose(private_head_ ? *private_head_ : served_->policy().weights.head);
}

void SessionHead::SuspendIfPaused(Session* session) const {
  if (served_->learning->paused()) session->learner->suspended = true;
}

void SessionHead::OnDecision(const ActionChoice& choice, absl::Span<const float> readout,
                             double return_to_go, double reward, Session* session) {
  if (!session->learner.has_value()) return;
  SuspendIfPaused(session);
  const auto outcome = session->learner->OnDecision(*session->options.learning, served_->policy(),
                                                    choice, readout, return_to_go, reward);
  OnUpdate(outcome, *session);
}

// Updates the private head and reports the outcome to the observer. An update that a fleet session
// applies to its contribution is not reported here: the merge at the end of the episode reports the
// outcome for the fleet head.
void SessionHead::OnUpdate(std::optional<UpdateOutcome> outcome, const Session& session) {
  if (!outcome.has_value()) return;
  if (*outcome == UpdateOutcome::kApplied) {
    if (IsInFleet()) return;
    HeadWith(served_->policy(), session.learner->head_delta, &*private_head_);
  }
  served_->observer->OnHeadUpdate(*outcome);
}

void SessionHead::OnExecuted(const Action& executed, Session* session) {
  if (session->learner.has_value()) SuspendIfPaused(session);
  const auto outcome = ReplaceLastAction(served_->policy(), executed, session);
  if (!outcome.has_value()) return;
  if (!IsInFleet()) HeadWith(served_->policy(), session->learner->head_delta, &*private_head_);
  // The observer has counted the update that an applied one replaces.
  if (*outcome != UpdateOutcome::kApplied) served_->observer->OnHeadUpdate(*outcome);
}

void SessionHead::OnOperator(const Action& executed, absl::string_view operator_id,
                             Session* session) {
  if (!session->learner.has_value()) return;
  SPIKESERVE_DCHECK(session->last_answer.has_value());
  SuspendIfPaused(session);
  const OperatorStep step = {
      .executed = executed, .operator_id = operator_id, .time = SecondsSince1970()};
  OnUpdate(
      session->learner->OnOperator(*session->options.learning, served_->policy(),
                                   session->last_answer->logits, step, session->options.head_delta),
      *session);
}

std::optional<int64_t> SessionHead::UndoCorrections(absl::string_view operator_id,
                                                    absl::Duration ago, Session* session) {
  if (IsInFleet() || !session->learner.has_value()) return std::nullopt;
  const auto undone =
      session->learner->UndoCorrections(*session->options.learning, served_->policy(), operator_id,
                                        SecondsSince1970() - absl::ToDoubleSeconds(ago));
  HeadWith(served_->policy(), session->learner->head_delta, &*private_head_);
  return undone;
}

std::optional<LearningSummary> SessionHead::OnEpisodeEnd(const EpisodeEnd& end,
                                                         double episode_return, const Clock& clock,
                                                         Session* session) {
  if (!session->learner.has_value()) return std::nullopt;
  return Learn(session->episode, end.reward, end.terminated, episode_return, clock, session);
}

bool SessionHead::AwaitVerdict(const EpisodeEnd& end, Session* session) {
  if (!session->learner.has_value()) return false;
  const LearningOptions& options = *session->options.learning;
  SuspendIfPaused(session);
  const double now = absl::ToDoubleSeconds(absl::Now() - absl::UnixEpoch());
  const bool waits =
      session->learner->AwaitVerdict(end.reward, {.episode = session->episode,
                                                  .terminated = end.terminated,
                                                  .target_return = session->target_return,
                                                  .until = now + options.verdict_seconds});
  if (!waits) return false;
  session->learner->StartEpisode(options);
  return true;
}

LearningSummary SessionHead::OnVerdict(const WaitingEpisode& ended, double episode_return,
                                       const Clock& clock, Session* session) {
  Learner& learner = *session->learner;
  std::erase_if(learner.waiting,
                [&](const auto& waiting) { return waiting->episode == ended.episode; });
  Learner running = learner;  // the episode that is played meanwhile
  learner.Recall(*session->options.learning, ended.factors);
  const LearningSummary summary = Learn(ended.episode, ended.factors.rewards.back(),
                                        ended.terminated, episode_return, clock, session);
  running.head_delta = std::move(learner.head_delta);
  running.returns = learner.returns;
  running.guard = std::move(learner.guard);
  learner = std::move(running);
  return summary;
}

LearningSummary SessionHead::Learn(int64_t episode, double reward, bool terminated,
                                   double episode_return, const Clock& clock, Session* session) {
  const LearningOptions& options = *session->options.learning;
  Learner& learner = *session->learner;
  SuspendIfPaused(session);
  OnUpdate(learner.OnEpisodeEnd(options, served_->policy(), reward, terminated), *session);
  LearningSummary summary = {.scope = options.scope,
                             .updates = learner.updates,
                             .rejected = learner.rejected,
                             .returns = learner.returns};
  if (IsInFleet()) {
    MergeIntoFleet(episode, episode_return, clock, session, &summary);
  } else {
    WatchPrivateHead(episode_return, session, &summary);
  }
  learner.StartEpisode(options);
  if (session->pending == nullptr) served_->observer->OnLearned(summary);
  return summary;
}

void SessionHead::MergeIntoFleet(int64_t episode, double episode_return, const Clock& clock,
                                 Session* session, LearningSummary* summary) {
  FleetHead& fleet = member_->head();
  const Learner& learner = *session->learner;
  Contribution contribution = {.episode = episode,
                               .contributor = member_->contributor(),
                               .held_out = member_->held_out(),
                               .operators = learner.operators,
                               .delta = learner.head_delta,
                               .episode_return = episode_return};
  const auto snapshot = fleet.Read();
  MergeOutcome outcome = {
      .paused = true, .drift = snapshot->drift, .watched_return = snapshot->level.mean};
  const bool is_logged = served_->log != nullptr;
  if (!is_logged && !learner.suspended) {
    served_->learning->MergeUnlessPaused([&] {
      ++contributions_;
      outcome = fleet.Merge(contribution, clock.Now());
      served_->observer->OnHeadUpdate(outcome.update);
    });
  }
  TakeOutcome(outcome, summary);
  if (!is_logged || learner.suspended) return;
  ++contributions_;
  contribution.summary = *summary;
  session->pending = std::make_shared<const Contribution>(std::move(contribution));
}

void SessionHead::WatchPrivateHead(double episode_return, Session* session,
                                   LearningSummary* summary) {
  Learner& learner = *session->learner;
  const bool was_measured = learner.guard.on_probation;
  if (!learner.suspended) {
    summary->rolled_back = learner.Watch(*session->options.learning, episode_return);
  }
  if (summary->rolled_back || was_measured)
    private_head_ = HeadWith(served_->policy(), learner.head_delta);
  summary->head_drift = Drift(*session);
  summary->watched_return = learner.guard.last.mean;
}

void SessionHead::NewContribution(const Session& session) {
  if (session.pending == nullptr) return;
  SPIKESERVE_DCHECK(IsInFleet());
  Contribution contribution = *session.pending;
  contribution.session = session.id;
  contribution.head = served_->HeadName(session.options.tenant);
  contribution.contributor = member_->contributor();
  contribution.held_out = member_->held_out();
  contribution_ = std::make_shared<FleetContribution>(served_, std::move(contribution));
}

void SessionHead::TakeMerged(Session* session) {
  if (contribution_ == nullptr) return;
  const auto merged = contribution_->merged();
  if (!merged.has_value()) return;
  const int64_t episode = contribution_->value().episode;
  contribution_ = nullptr;
  session->pending = nullptr;
  for (Verdict& verdict : session->verdicts) {
    if (verdict.episode != episode) continue;
    verdict.learning = *merged;
    return;
  }
  if (session->last_end == nullptr) return;
  auto ended = std::make_shared<EndedEpisode>(*session->last_end);
  ended->summary.learning = *merged;
  session->last_end = std::move(ended);
}

Eigen::VectorXf SessionHead::Delta(const Session& session) const {
  if (IsInFleet()) return member_->head().Read()->delta;
  return session.learner.has_value() ? session.learner->head_delta : session.options.head_delta;
}

double SessionHead::Drift(const Session& session) const {
  if (IsInFleet()) return member_->head().Read()->drift;
  return FrobeniusNorm(Delta(session)) / BaseNorm(served_->policy());
}

int64_t SessionHead::Rollbacks(const Session& session) const {
  if (IsInFleet()) return member_->head().Read()->rollbacks;
  return session.learner.has_value() ? session.learner->guard.rollbacks : 0;
}

}  // namespace spikeserve
