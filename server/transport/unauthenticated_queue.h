// Shares the time of a loop between unauthenticated and authenticated clients.
//
// Unauthenticated connections have no call that was admitted. They may connect, negotiate TLS,
// which takes up to a millisecond of processor time, and make calls that need no token, as often as
// they like. All of them together get at most half of the loop's time; those that would exceed it
// wait in turn.
//
// Confined to the thread of its loop.
#pragma once

#include <deque>

#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/transport/event_loop.h"

namespace spikeserve {

class UnauthenticatedQueue {
 public:
  // What works for an unauthenticated connection.
  class Waiter {
   public:
    // It is the waiter's turn: it takes one step, of about a millisecond at most, with Run().
    virtual void OnTurn() = 0;

   protected:
    ~Waiter() = default;
  };

  // `loop` and `clock` must outlive the queue.
  UnauthenticatedQueue(EventLoop* loop, const Clock* clock) : loop_(loop), clock_(clock) {}

  // Returns true if a step may run now, false if it has to wait.
  bool MayRun() const { return waiting_.empty() && IsDue(); }

  // Runs a step and counts its time.
  template <typename Step>
  void Run(const Step& step) {
    const absl::Duration start = clock_->Now();
    step();
    Charge(start);
  }

  // Calls `waiter` when it is its turn. REQUIRES: it does not wait yet.
  void Wait(Waiter* waiter);
  void Remove(Waiter* waiter) { std::erase(waiting_, waiter); }

 private:
  // Counts the time since `start`.
  void Charge(absl::Duration start);
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
