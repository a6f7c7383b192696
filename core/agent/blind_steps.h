// The steps of a running episode that have no observation, until a step that has one, or the end of
// the episode, follows: a session is never left without a context. For an engine that plays step
// by step what a server takes from a history (beats.h).
//
//   blind.Add(reward, executed, &agent);               // a step without an observation
//   if (blind.Skip(&agent)) executed = std::nullopt;  // before a decision
//   blind.Taken();                                     // after it has succeeded
//
// Not thread-safe.
#ifndef CORE_AGENT_BLIND_STEPS_H_
#define CORE_AGENT_BLIND_STEPS_H_

#include <optional>
#include <vector>

#include "absl/status/status.h"
#include "core/action/reported_action.h"
#include "core/agent/agent_session.h"
#include "core/base/status_macros.h"

namespace spikeserve {

class BlindSteps {
 public:
  // Adds a step with the reward of the action before it, in whose place `executed` was executed.
  absl::Status Add(double reward, const std::optional<ReportedAction>& executed,
                   AgentSession* agent) {
    if (rewards_.empty() && executed.has_value() && !agent->session().history.empty()) {
      ASSIGN_OR_RETURN(const Action action,
                       ParseExecutedAction(*executed, agent->policy().action_space));
      agent->ReportExecuted(action);
    }
    rewards_.push_back(reward);
    return absl::OkStatus();
  }

  // Skips the steps in the session, whose next step then follows; if it fails, the session is as it
  // was. Returns whether there were any.
  bool Skip(AgentSession* agent) {
    if (rewards_.empty()) return false;
    agent->SkipSteps(rewards_);
    return true;
  }
  // Notes that the session has them.
  void Taken() { rewards_.clear(); }

  size_t size() const { return rewards_.size(); }

 private:
  std::vector<double> rewards_;
};

}  // namespace spikeserve

#endif  // CORE_AGENT_BLIND_STEPS_H_
