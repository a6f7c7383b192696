#include "server/transport/handshake_queue.h"

#include <algorithm>

namespace spikeserve {
namespace {

// Handshakes may be this far ahead of their share of the time.
constexpr absl::Duration kBurst = absl::Milliseconds(1);
constexpr int kShare = 2;  // 1 / 2 of the time

}  // namespace

bool HandshakeQueue::IsDue() const { return rest_until_ <= clock_->Now() + kBurst; }

void HandshakeQueue::Charge(absl::Duration spent) {
  rest_until_ = std::max(rest_until_, clock_->Now() - spent) + kShare * spent;
}

void HandshakeQueue::Wait(Waiter* waiter) {
  waiting_.push_back(waiter);
  SetTimer();
}

void HandshakeQueue::SetTimer() {
  if (has_timer_ || waiting_.empty()) return;
  has_timer_ = true;
  const absl::Duration rest = rest_until_ - kBurst - clock_->Now();
  loop_->After(std::max(rest, absl::ZeroDuration()), [this] { RunWaiting(); });
}

void HandshakeQueue::RunWaiting() {
  has_timer_ = false;
  while (!waiting_.empty() && IsDue()) {
    Waiter* const next = waiting_.front();
    waiting_.pop_front();
    next->ContinueHandshake();
  }
  SetTimer();
}

}  // namespace spikeserve
