#include "core/session/session_value.h"

#include <cmath>
#include <limits>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/contract/dcheck.h"
#include "core/engine/energy.h"
#include "core/engine/engine.h"

namespace spikeserve {
namespace {

// Returns whether `value` is finite as a float32, the type that the model reads.
bool IsFiniteFloat(double value) {
  return std::abs(value) <= static_cast<double>(std::numeric_limits<float>::max());
}

}  // namespace

Session NewSession(std::string id, SessionOptions options) {
  Session session;
  session.id = std::move(id);
  session.target_return = options.target_return;
  session.return_to_go = options.target_return;
  session.options = std::move(options);
  return session;
}

double NextReturnToGo(const Session& session, double reward) {
  return session.step == 0 ? session.target_return : session.return_to_go - reward;
}

std::optional<UpdateOutcome> ReplaceLastAction(const Policy& policy, const Action& executed,
                                               Session* session) {
  SPIKESERVE_DCHECK(session->last_answer.has_value());
  SPIKESERVE_DCHECK(policy.action_space.Contains(executed).ok());
  session->history.ReplaceLastAction(executed);
  if (!session->learner.has_value()) return std::nullopt;
  const Answer& answer = *session->last_answer;
  return session->learner->OnExecuted(
      *session->options.learning, policy, session->options.action_selection, answer.logits,
      answer.action, executed, static_cast<double>(answer.return_to_go));
}

void CountDecision(const Policy& policy, Answer answer, absl::Span<const float> observation,
                   double reward, Session* session) {
  SPIKESERVE_DCHECK_EQ(observation.size(), static_cast<size_t>(policy.observation_size()));
  const auto limit = static_cast<size_t>(HistorySize(policy.config));
  session->history.Append(answer.return_to_go, observation, answer.action, limit);

  const uint64_t spikes = answer.counts.total_spikes();
  const double energy = DefaultEnergy(answer.counts, policy.config);
  session->return_to_go = NextReturnToGo(*session, reward);
  session->episode_return += reward;
  session->episode_spikes += spikes;
  session->episode_energy_joules += energy;
  session->spikes += spikes;
  session->energy_joules += energy;
  ++session->step;
  ++session->decisions;
  session->last_answer = std::move(answer);
  session->executed_source = session->last_answer->source;
}

void CountSkipped(double reward, Session* session) {
  const double counted = session->step == 0 ? 0.0 : reward;
  session->return_to_go = NextReturnToGo(*session, counted);
  session->episode_return += counted;
  ++session->step;
  ++session->decisions;
  if (session->learner.has_value()) {
    session->learner->OnSkipped(*session->options.learning, counted);
  }
}

absl::Status CheckTargetReturn(double target_return) {
  if (IsFiniteFloat(target_return)) return absl::OkStatus();
  return InvalidArgument("target_return", "a finite number within float32", target_return);
}

absl::Status CheckObservation(absl::Span<const float> observation, int expected_size) {
  if (observation.size() != static_cast<size_t>(expected_size)) {
    return InvalidArgument("observation", absl::StrCat(expected_size, " numbers"),
                           observation.size());
  }
  for (size_t i = 0; i < observation.size(); ++i) {
    if (!std::isfinite(observation[i])) {
      return InvalidArgument(absl::StrCat("observation[", i, "]"), "a finite number",
                             observation[i]);
    }
  }
  return absl::OkStatus();
}

absl::Status CheckReward(double reward, double next_return_to_go) {
  if (!std::isfinite(reward)) {
    return InvalidArgument("reward", "a finite number", reward);
  }
  if (!IsFiniteFloat(next_return_to_go)) {
    return InvalidArgument("reward", "a return-to-go within float32",
                           absl::StrCat(reward, ", which makes it ", next_return_to_go));
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
