// Decides whether a robot's steps go over its stream, as datagrams, or both ways.
//
// A step goes both ways while it is not known whether datagrams come through: before the first one
// is answered, when one that should be answered is not, and after an error. So a firewall costs no
// step that the stream would not: the session is whole in any case, and a step that both ways carry
// is decided once. An answer to a datagram ends the doubt.
//
// A pure state machine. Not thread-safe.
#pragma once

#include <cstdint>
#include <optional>

#include "core/robot/in_flight.h"
#include "core/robot/time.h"

namespace spikeserve::robot {

// How a request goes.
struct Ways {
  bool stream = true;
  bool datagram = false;
};

class TransportChoice {
 public:
  // Datagrams in doubt that are sent with each step; later ones probe the way once in kProbe.
  static constexpr uint64_t kTries = 10;
  static constexpr Time kProbe = std::chrono::seconds(1);
  // So many errors about the order without an answer are more than that.
  static constexpr int kDisorders = 3;

  // With `is_allowed` false, everything goes over the stream.
  TransportChoice(bool is_allowed, Time period) : is_allowed_(is_allowed), period_(period) {}

  // The server offers a channel until then.
  void Offer(Time until) {
    if (!is_allowed_) return;
    // Another key of a channel that works continues it.
    if (until_ == kLongAgo) is_doubted_ = true;
    until_ = until;
    unanswered_ = 0;
  }

  void Withdraw() { until_ = kLongAgo; }

  bool is_offered(Time now) const { return now < until_; }
  Ways Choose(Time now) const {
    if (!is_offered(now)) return {};
    if (!is_doubted_) return {.stream = false, .datagram = true};
    return {.stream = true, .datagram = unanswered_ < kTries || now - sent_at_ >= kProbe};
  }

  void OnSent(Time now) {
    ++unanswered_;
    sent_at_ = now;
  }

  void OnAnswer(Time sent, Time now) {
    const Time took = now - sent;
    const Time error = took - round_trip_.value_or(took / 2);
    deviation_ = round_trip_.has_value() ? deviation_ + (abs(error) - deviation_) / 4 : error;
    round_trip_ = round_trip_.has_value() ? *round_trip_ + error / 8 : took;
    is_doubted_ = false;
    unanswered_ = disorders_ = 0;
  }

  // Datagrams are refused. An error about their order may only mean that a newer one was faster.
  void OnError(bool is_order) {
    if (!is_order || ++disorders_ >= kDisorders) is_doubted_ = true;
  }
  // Returns whether the answer to a datagram takes longer than usual.
  bool IsLate(Time sent, Time now) const {
    return round_trip_.has_value() && sent + *round_trip_ + 4 * deviation_ < now;
  }
  // Notices if `waiting`, which are not answered, are overdue.
  // One that was lost alone is not overdue: the answer to the next one comes first.
  void Check(const InFlight& waiting, Time now) {
    if (waiting.empty() || !round_trip_.has_value()) return;
    if (waiting.front().sent + *round_trip_ * 5 / 4 + period_ < now) is_doubted_ = true;
  }

 private:
  const bool is_allowed_;
  const Time period_;
  Time until_ = kLongAgo;  // of the channel
  bool is_doubted_ = true;
  uint64_t unanswered_ = 0;  // sent since the last answer
  int disorders_ = 0;        // errors about the order since then
  Time sent_at_ = kLongAgo;
  std::optional<Time> round_trip_;  // smoothed, as in RFC 6298
  Time deviation_ = Time::zero();   // of it, smoothed
};

}  // namespace spikeserve::robot
