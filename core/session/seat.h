// Defines the operator who acts in the place of a session's policy. Plain values.
#pragma once

#include <cstdint>
#include <string>

#include "core/action/action_space.h"

namespace spikeserve {

struct Seat {
  std::string operator_id;
  std::string lease_id;
  double lease_seconds = 0.0;
  // Of the lease, when the session decided last. A server that takes the session over goes on from
  // here, so no clocks are compared.
  double left_seconds = 0.0;
  Action action;             // that the session answers with
  int64_t steps = 0;         // that were answered so
  int64_t agreed_steps = 0;  // those for which the policy had chosen the same action

  friend bool operator==(const Seat&, const Seat&) = default;
};

}  // namespace spikeserve
