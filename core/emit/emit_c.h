// Writes a policy in integer arithmetic as one C99 source and header, for microcontrollers.
//
//   ASSIGN_OR_RETURN(const EmittedC c, EmitC(bytes_of_the_file, {.name = "cartpole"}));
//   // c.source decides as the server does, bit for bit, without heap, libm or recursion.
//
// Pure functions, thread-safe.
#pragma once

#include <cstdint>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

struct EmitOptions {
  std::string name;  // of the policy and its version, as a server names them
  int64_t version = 1;
  int64_t most_state = 0;  // bytes that the state may have; 0: any number
};

struct EmittedC {
  std::string header;       // spike_policy.h
  std::string source;       // spike_policy.c
  int64_t table_bytes = 0;  // of constants, for the flash
  int64_t state_bytes = 0;  // of spike_state, for the RAM
};

// Writes the policy of a file. INVALID_ARGUMENT if the file is no policy, or the name has more than
// 128 bytes or characters that are not printable. FAILED_PRECONDITION, which says what to do, if
// the policy is dense, is not in integer arithmetic, has sums of attention of more than 31 bits, or
// needs more than `most_state`.
absl::StatusOr<EmittedC> EmitC(absl::string_view policy_file, const EmitOptions& options);

}  // namespace spikeserve
