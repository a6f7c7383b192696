// Writes the numbers of an integer policy as C tables, for the sources of core/emit/c.
//
// Pure functions, thread-safe.
#pragma once

#include <cstdint>
#include <string>

#include "core/model/policy.h"

namespace spikeserve {

struct PolicyTables {
  std::string text;
  int64_t bytes = 0;  // of the numbers
};

// Returns the tables of the weights. REQUIRES: a spiking policy in integer arithmetic.
PolicyTables TablesOf(const Policy& policy);

}  // namespace spikeserve
