#include "core/agent/session_passes.h"

#include <limits>

namespace spikeserve {

void AgentSession::Apply(absl::Span<Step* const> steps, StepBudget* budget) {
  thread_local std::vector<Step*> deciding;
  deciding.clear();
  StepBudget all = {.steps = std::numeric_limits<int64_t>::max()};
  if (budget == nullptr) budget = &all;
  for (Step* step : steps) {
    StepOutcome& result = step->result;
    result.finished = true;
    if (step->end.has_value()) {
      EndPass::Take(*step, budget);
      continue;
    }
    const bool comes_alone =
        !step->has_past() && !step->times.has_value() && step->session->blind_rewards_.empty();
    const auto decides = comes_alone ? true : HistoryPass::Take(*step, budget);
    result.status = decides.status();
    if (decides.ok() && *decides && DecisionPass::IsNew(*step)) deciding.push_back(step);
  }
  DecisionPass::Decide(deciding);
}

void AgentSession::AppendPendingActions(absl::Span<AgentSession* const> sessions) {
  thread_local std::vector<AgentSession*> certain;
  certain.clear();
  for (AgentSession* session : sessions) {
    if (!session->context_.expects_executed) certain.push_back(session);
  }
  DecisionPass::AppendActions(certain);
}

}  // namespace spikeserve
