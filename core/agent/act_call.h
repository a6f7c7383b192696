// Defines one Act among several that are decided together.
#ifndef CORE_AGENT_ACT_CALL_H_
#define CORE_AGENT_ACT_CALL_H_

#include <cstdint>
#include <optional>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/action/reported_action.h"
#include "core/session/session.h"

namespace spikeserve {

class AgentSession;

// The arguments and the result, as AgentSession::Act() has them.
struct ActCall {
  AgentSession* session = nullptr;
  int64_t step = 0;
  absl::Span<const float> observation;
  double reward = 0.0;
  // Number of the decision in the session, from 0; absent: `step` alone identifies the request.
  std::optional<uint64_t> decision = std::nullopt;
  std::optional<ReportedAction> executed = std::nullopt;
  // True: nobody asked for the decision; it is a step that the agent took without the server.
  bool is_beat = false;
  absl::StatusOr<const Answer*> answer = nullptr;  // what Act would return
  bool is_retry = false;                           // true: `answer` is the stored one
};

}  // namespace spikeserve

#endif  // CORE_AGENT_ACT_CALL_H_
