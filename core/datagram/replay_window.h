// Which numbers of one direction have arrived, as in RFC 6479: what comes twice, or long after
// newer ones, is refused.
//
// Not thread-safe.
#pragma once

#include <array>
#include <cstdint>

namespace spikeserve {

class ReplayWindow {
 public:
  // Numbers that are this far behind the newest one count as replayed.
  static constexpr uint64_t kSize = 1024;

  // Returns whether `number` would be new.
  bool IsNew(uint64_t number) const;
  // Notes `number`. Returns whether it is the newest one. REQUIRES: IsNew(number).
  bool Add(uint64_t number);

 private:
  static constexpr uint64_t kBits = 64;  // of a word
  static constexpr uint64_t kWords = kSize / kBits + 1;

  uint64_t past_ = 0;  // the number behind the newest one
  std::array<uint64_t, kWords> seen_ = {};
};

}  // namespace spikeserve
