#include "core/agent/explanation.h"

#include <cstdint>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "core/engine/factory/engine_factory.h"
#include "core/engine/prefix_engine.h"

namespace spikeserve {
namespace {

// Returns the tokens of the session's history, up to the last state token.
PrefixContext TokensOf(const Policy& policy, const Session& session) {
  const auto timesteps = static_cast<int64_t>(session.history.size());
  PrefixContext prefix(session.step - timesteps);
  std::vector<float> action(static_cast<size_t>(policy.action_space.size()));
  const History& history = session.history;
  for (size_t i = 0; i < history.size(); ++i) {
    if (i > 0) {
      policy.action_space.Encode(history.action(i - 1), absl::MakeSpan(action));
      prefix.AppendAction(action);
    }
    prefix.AppendReturnAndState(policy, history.return_to_go(i), history.observation(i));
  }
  return prefix;
}

}  // namespace

absl::StatusOr<Explanation> Explain(const Policy& policy, const Session& session) {
  if (!session.last_answer.has_value()) {
    return absl::FailedPreconditionError(
        "session_id: expected a session that has decided in its running episode, received one at "
        "step 0");
  }
  Explanation explanation;
  Engine::Output output;
  TraceDecision(policy, TokensOf(policy, session), &output, &explanation.trace);
  if (output.counts != session.last_answer->counts) {
    return absl::InternalError(
        absl::StrCat("counts: expected those of the answer at step ", session.last_answer->step,
                     " (", session.last_answer->counts.total_spikes(), " spikes), received ",
                     output.counts.total_spikes(), " spikes, or other operations"));
  }
  explanation.readout = std::move(output.readout);
  return explanation;
}

}  // namespace spikeserve
