// The methods of AgentSession for episodes that wait for their verdicts.
#include <algorithm>
#include <memory>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/agent/agent_session.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

using Waiting = std::vector<std::shared_ptr<const WaitingEpisode>>;

// Returns the rewards of a waiting episode with those of `amendment`.
absl::StatusOr<std::vector<double>> Amended(const Amendment& amendment,
                                            const std::vector<double>& received) {
  if (!amendment.rewards.empty() && amendment.rewards.size() != received.size()) {
    return InvalidArgument("rewards", absl::StrCat(received.size(), " numbers, one a step"),
                           amendment.rewards.size());
  }
  std::vector<double> rewards = amendment.rewards.empty() ? received : amendment.rewards;
  rewards.back() += amendment.reward;
  return rewards;
}

}  // namespace

absl::StatusOr<Verdict> AgentSession::Amend(const Amendment& amendment) {
  head_.TakeMerged(&session_);
  const int64_t episode = amendment.episode;
  for (const Verdict& verdict : session_.verdicts) {
    if (verdict.episode != episode || verdict.id != amendment.id) continue;
    if (verdict.digest == amendment.digest) return verdict;
    return absl::AlreadyExistsError(
        absl::StrCat("amendment_id: expected the same verdict as before, or another name, received "
                     "another verdict of ",
                     amendment.id));
  }
  LearnOverdue();
  for (const Verdict& verdict : session_.verdicts) {
    if (verdict.episode != episode || !verdict.id.empty()) continue;
    return absl::FailedPreconditionError(
        absl::StrCat("episode: expected a verdict within learning.verdict_seconds, received one of "
                     "episode ",
                     episode, ", which has been learned from as it was"));
  }
  const Waiting waiting = session_.learner.has_value() ? session_.learner->waiting : Waiting();
  const auto found = std::find_if(waiting.begin(), waiting.end(), [episode](const auto& ended) {
    return ended->episode == episode;
  });
  if (found == waiting.end()) {
    return absl::NotFoundError(absl::StrCat(
        "episode: expected one that waits for its verdict or is recorded, received ", episode));
  }
  ASSIGN_OR_RETURN(auto rewards, Amended(amendment, (*found)->factors.rewards));
  if (contribution() != nullptr) {
    return absl::UnavailableError(
        "fleet head: has not taken another episode of the session yet; try again");
  }
  Judge(**found, std::move(rewards),
        {.episode = episode, .id = amendment.id, .digest = amendment.digest});
  return session_.verdicts.back();
}

bool AgentSession::Settle() {
  head_.TakeMerged(&session_);
  LearnOverdue();
  return contribution() != nullptr ||
         (session_.learner.has_value() && !session_.learner->waiting.empty());
}

void AgentSession::LearnOverdue() {
  if (!session_.learner.has_value()) return;
  const Waiting& waiting = session_.learner->waiting;
  while (!waiting.empty() && contribution() == nullptr &&
         waiting.front()->until <= absl::ToDoubleSeconds(absl::Now() - absl::UnixEpoch())) {
    const auto ended = waiting.front();
    Judge(*ended, ended->factors.rewards, {.episode = ended->episode});
  }
}

void AgentSession::Judge(const WaitingEpisode& ended, std::vector<double> rewards,
                         Verdict verdict) {
  WaitingEpisode judged = ended;
  judged.factors.rewards = std::move(rewards);
  for (const double reward : judged.factors.rewards) verdict.episode_return += reward;
  const double episode_return = verdict.episode_return;
  verdict.learning = head_.OnVerdict(judged, episode_return, *clock_, &session_);
  std::vector<Verdict>& verdicts = session_.verdicts;
  if (verdicts.size() >= Session::kMostVerdicts) verdicts.erase(verdicts.begin());
  verdicts.push_back(std::move(verdict));
  ++session_.interventions;
  Report(&SessionListener::OnVerdict, episode_return, ended.target_return);
}

void AgentSession::Report(EndReport report, std::optional<double> episode_return,
                          double target_return) {
  head_.NewContribution(session_);
  bool is_taken = false;
  for (const auto& listener : listeners_) {
    if (((*listener).*report)(session_, contribution())) is_taken = true;
  }
  if (contribution() != nullptr && !is_taken) contribution()->Append();
  if (!episode_return.has_value()) return;
  // A target may be more than the policy has ever reached.
  const double reached = TrainingReturn(policy()).value_or(target_return);
  life_.OnEpisode(*episode_return, std::min(target_return, reached));
  served_->observer->OnEpisodeEnd(*episode_return);
}

}  // namespace spikeserve
