#include "core/robot/transport_choice.h"

namespace spikeserve::robot {

void TransportChoice::Offer(Time until) {
  if (!is_allowed_) return;
  // Another key of a channel that works continues it.
  if (until_ == kLongAgo) is_doubted_ = true;
  until_ = until;
  unanswered_ = 0;
}

Ways TransportChoice::Choose(Time now) const {
  if (!is_offered(now)) return {};
  if (!is_doubted_) return {.stream = false, .datagram = true};
  return {.stream = true, .datagram = unanswered_ < kTries || now - sent_at_ >= kProbe};
}

void TransportChoice::OnSent(Time now) {
  ++unanswered_;
  sent_at_ = now;
}

void TransportChoice::OnAnswer(Time sent, Time now) {
  const Time took = now - sent;
  const Time error = took - round_trip_.value_or(took / 2);
  deviation_ = round_trip_.has_value() ? deviation_ + (abs(error) - deviation_) / 4 : error;
  round_trip_ = round_trip_.has_value() ? *round_trip_ + error / 8 : took;
  is_doubted_ = false;
  unanswered_ = disorders_ = 0;
}

// One that was lost alone is not overdue: the answer to the next one comes first.
void TransportChoice::Check(const InFlight& waiting, Time now) {
  if (waiting.empty() || !round_trip_.has_value()) return;
  if (waiting.front().sent + *round_trip_ * 5 / 4 + period_ < now) is_doubted_ = true;
}

}  // namespace spikeserve::robot
