#include "core/datagram/replay_window.h"

#include <algorithm>

namespace spikeserve {

bool ReplayWindow::IsNew(uint64_t number) const {
  if (number >= past_) return true;
  if (past_ - 1 - number >= kSize) return false;
  return (seen_[number / kBits % kWords] >> (number % kBits) & 1U) == 0;
}

bool ReplayWindow::Add(uint64_t number) {
  const bool is_newest = number >= past_;
  if (is_newest) {
    // The words between the newest one and that of `number` are of numbers that did not arrive.
    const uint64_t newest_word = past_ == 0 ? 0 : (past_ - 1) / kBits;
    const uint64_t steps = std::min(number / kBits - newest_word, kWords);
    for (uint64_t i = 0; i < steps; ++i) seen_[(number / kBits - i) % kWords] = 0;
    past_ = number + 1;
  }
  seen_[number / kBits % kWords] |= uint64_t{1} << (number % kBits);
  return is_newest;
}

}  // namespace spikeserve
