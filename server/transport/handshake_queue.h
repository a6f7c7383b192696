// Shares the time of a loop between TLS handshakes and everything else.
//
// A handshake takes up to a millisecond of processor time, and strangers may start as many as they
// like. Handshakes get at most half of the loop's time; those that would exceed it wait in turn.
//
// Confined to the thread of its loop.
#ifndef SERVER_TRANSPORT_HANDSHAKE_QUEUE_H_
#define SERVER_TRANSPORT_HANDSHAKE_QUEUE_H_

#include <deque>

#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/transport/event_loop.h"

namespace spikeserve {

class HandshakeQueue {
 public:
  // A connection that waits to continue its handshake.
  class Waiter {
   public:
    // It is the waiter's turn: it takes one step and calls Charge().
    virtual void ContinueHandshake() = 0;

   protected:
    ~Waiter() = default;
  };

  // `loop` and `clock` must outlive the queue.
  HandshakeQueue(EventLoop* loop, const Clock* clock) : loop_(loop), clock_(clock) {}

  // Returns true if a handshake may take a step now, false if it has to wait.
  bool MayStep() const { return waiting_.empty() && IsDue(); }

  // Calls `waiter` when it is its turn. REQUIRES: it does not wait yet.
  void Wait(Waiter* waiter);
  void Remove(Waiter* waiter) { std::erase(waiting_, waiter); }

  // Counts the processor time of a step.
  void Charge(absl::Duration spent);

  absl::Duration Now() const { return clock_->Now(); }

 private:
  bool IsDue() const;
  void RunWaiting();
  void SetTimer();

  EventLoop* const loop_;
  const Clock* const clock_;
  std::deque<Waiter*> waiting_;
  absl::Duration rest_until_;  // when the steps so far took half of the time
  bool has_timer_ = false;
};

}  // namespace spikeserve

#endif  // SERVER_TRANSPORT_HANDSHAKE_QUEUE_H_
