// Selects the fleet sessions that are held out: while their shared head is protected, they play
// with it and contribute nothing, so that their returns judge what others have contributed.
//
// Free functions, safe to call from many threads.
#pragma once

#include <array>
#include <cstdint>
#include <random>

#include "absl/strings/string_view.h"
#include "core/math/counter_random.h"

namespace spikeserve {

// One session in this many is held out.
inline constexpr uint64_t kHeldOutShare = 5;

// A secret of the server: clients draw the ids of their sessions, and must not choose the role.
using HeldOutKey = std::array<uint64_t, 2>;

inline HeldOutKey RandomHeldOutKey() {
  std::random_device random;
  const auto word = [&] { return (uint64_t{random()} << 32) | random(); };
  return {word(), word()};
}

// Returns true if the session is held out.
constexpr bool IsHeldOut(const HeldOutKey& key, absl::string_view session_id) {
  uint64_t state = key[0];
  for (const char c : session_id) {
    state = RandomBits({state, static_cast<unsigned char>(c), key[1]});
  }
  return ((state >> 32) * kHeldOutShare) >> 32 == 0;
}

}  // namespace spikeserve
