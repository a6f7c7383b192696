// What a robot has executed in the place of an answer. A plain value.
#ifndef SPIKESERVE_EXECUTED_ACTION_H_
#define SPIKESERVE_EXECUTED_ACTION_H_

#include <utility>

#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// An executed action, and who chose it. Without a source: the policy, if it is the answered action.
struct ExecutedAction {
  // NOLINTNEXTLINE(google-explicit-constructor): an action is enough
  ExecutedAction(v1::Action executed, v1::ActionSource chosen_by = {})
      : action(std::move(executed)), source(std::move(chosen_by)) {}

  v1::Action action;
  v1::ActionSource source;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_EXECUTED_ACTION_H_
