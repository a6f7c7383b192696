// The requests of a robot that have no reply.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "core/robot/time.h"

namespace spikeserve::robot {

// A request for the newest step of an episode, or one that ends it.
struct SentRequest {
  int64_t episode = 0;  // index
  uint64_t number = 0;  // of the step
  Time sent = kLongAgo;
  bool ends = false;  // it ends the episode
  bool asks = true;   // for a decision
  uint64_t id = 0;    // of a datagram
};

// A queue, oldest first, in memory of its own.
class InFlight {
 public:
  static constexpr size_t kMost = 64;

  bool empty() const { return size_ == 0; }
  size_t size() const { return size_; }
  const SentRequest& front() const { return (*this)[0]; }
  const SentRequest& operator[](size_t i) const { return ring_[(begin_ + i) % kMost]; }
  // REQUIRES: size() < kMost.
  void Push(const SentRequest& request) { ring_[(begin_ + size_++) % kMost] = request; }
  SentRequest Pop() {
    const SentRequest request = front();
    begin_ = (begin_ + 1) % kMost;
    --size_;
    return request;
  }
  void Clear() { size_ = 0; }

 private:
  std::array<SentRequest, kMost> ring_;
  size_t begin_ = 0;
  size_t size_ = 0;
};

}  // namespace spikeserve::robot
