#include "server/transport/unauthenticated_queue.h"

#include <algorithm>

#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// Unauthenticated connections may be this far ahead of their share of the time.
constexpr absl::Duration kBurst = absl::Milliseconds(1);
constexpr int kShare = 2;  // 1 / 2 of the time

}  // namespace

bool UnauthenticatedQueue::IsDue() const { return rest_until_ <= clock_->Now() + kBurst; }

void UnauthenticatedQueue::Charge(absl::Duration start) {
  rest_until_ = std::max(rest_until_, start) + kShare * (clock_->Now() - start);
}

void UnauthenticatedQueue::Wait(Waiter* waiter) {
  loop_->thread().AssertCurrent();
  SPIKESERVE_DCHECK(std::find(waiting_.begin(), waiting_.end(), waiter) == waiting_.end());
  waiting_.push_back(waiter);
  SetTimer();
}

void UnauthenticatedQueue::SetTimer() {
  if (has_timer_ || waiting_.empty()) return;
  has_timer_ = true;
  const absl::Duration rest = rest_until_ - kBurst - clock_->Now();
  loop_->After(std::max(rest, absl::ZeroDuration()), [this] { RunWaiting(); });
}

void UnauthenticatedQueue::RunWaiting() {
  has_timer_ = false;
  while (!waiting_.empty() && IsDue()) {
    Waiter* const next = waiting_.front();
    waiting_.pop_front();
    next->OnTurn();
  }
  SetTimer();
}

}  // namespace spikeserve
