// The methods of AgentSession for what an agent did without the server.
#include <memory>

#include "core/session/agent_session.h"
#include "core/session/session_value.h"

namespace spikeserve {

absl::Status AgentSession::Append(absl::Span<const float> observation, double reward,
                                  const std::optional<ReportedAction>& executed) {
  ActCall call = {.session = this,
                  .step = session_.step,
                  .observation = observation,
                  .reward = reward,
                  .decision = session_.decisions,  // so that it is never a retry
                  .executed = executed,
                  .is_beat = true};
  ActTogether(absl::MakeSpan(&call, 1));
  return call.answer.status();
}

void AgentSession::SkipSteps(absl::Span<const double> rewards) {
  TakeMerged();
  before_skipped_ = std::make_unique<const Session>(session_);
  for (const double reward : rewards) CountSkipped(reward, &session_);
  session_.history.Clear();
  DropContext();
  if (recorder_ != nullptr) recorder_->OnGap();
}

void AgentSession::ReportExecuted(const Action& executed) {
  if (executed == session_.history.action(session_.history.size() - 1)) return;
  TakeExecuted(executed);
  if (journal_ != nullptr) journal_->OnChange(session_);
}

}  // namespace spikeserve
