// Selects the fleet sessions that are held out: while their shared head is protected, they play
// with it and contribute nothing, so that their returns judge what others have contributed.
//
// Pure functions, safe to call from many threads.
#ifndef CORE_LEARNING_HELD_OUT_H_
#define CORE_LEARNING_HELD_OUT_H_

#include <cstdint>

#include "absl/strings/string_view.h"

namespace spikeserve {

// One session in this many is held out.
inline constexpr uint64_t kHeldOutShare = 5;

// Returns true if the session is held out. This depends on its id alone, so that all servers agree
// and a session that moves keeps its role.
constexpr bool IsHeldOut(absl::string_view session_id) {
  // FNV-1a with 32 bits (Fowler, Noll & Vo), whose upper bits are mixed best.
  uint32_t hash = 2166136261u;
  for (const char c : session_id) hash = (hash ^ static_cast<unsigned char>(c)) * 16777619u;
  return (uint64_t{hash} * kHeldOutShare) >> 32 == 0;
}

}  // namespace spikeserve

#endif  // CORE_LEARNING_HELD_OUT_H_
