// What all loops of a transport count together.
#pragma once

#include "server/base/byte_budget.h"

namespace spikeserve {

// Thread-safe.
struct TransportBudgets {
  ByteBudget all;  // TransportLimits::max_bytes_in_flight
  ByteBudget
      unauthenticated;  // TransportLimits::max_unauthenticated_bytes; their calls count above, too
};

}  // namespace spikeserve
