// One caller of a load test: its agents over one exchange.
//
// In a closed loop every agent has one request under way and sends its next when it has the answer.
// At a rate, requests fall due on a fixed schedule, and each goes out as soon as an agent is free
// for it; its latency counts from when it was due, so that a server which stalls is charged for all
// the requests that it kept waiting, and not only for those it kept under way (coordinated
// omission).
//
// An agent whose request failed for no lasting reason repeats it after a pause; after any other
// error it is retired.
//
// Not thread-safe; runs on a thread of its own.
#ifndef LOADTEST_CALLER_H_
#define LOADTEST_CALLER_H_

#include <chrono>
#include <deque>
#include <memory>
#include <string>
#include <unordered_map>
#include <vector>

#include "absl/time/time.h"
#include "loadtest/exchange.h"
#include "loadtest/load_report.h"
#include "loadtest/simulated_agent.h"

namespace spikeserve {

// When requests fall due: after `offset`, and from then on every `interval`.
struct Schedule {
  std::chrono::steady_clock::duration offset;
  std::chrono::steady_clock::duration interval;
};

class Caller {
 public:
  // The pause keeps a server that refuses everything from being flooded. `patience` is longer than
  // any call may take, so that only a server that has gone silent runs into it.
  Caller(std::unique_ptr<Exchange> exchange, std::vector<SimulatedAgent> agents,
         absl::Duration pause_after_error, absl::Duration patience);

  // Each sends requests for `duration`, then waits for the answers under way.
  LoadReport RunClosedLoop(std::chrono::steady_clock::duration duration);
  LoadReport RunAtRate(const Schedule& schedule, std::chrono::steady_clock::duration duration);

  // Ends the sessions of all agents, retired ones too, and returns the first error.
  absl::Status CloseSessions();

 private:
  using Time = std::chrono::steady_clock::time_point;

  void Send(SimulatedAgent& agent, Time due);
  // The agent that may go on, or null.
  SimulatedAgent* TakeReply(const ActReply& reply);
  void LoseRequestsUnderWay(const absl::Status& status);

  std::unique_ptr<Exchange> exchange_;
  absl::Duration pause_after_error_;
  absl::Duration patience_;
  std::unordered_map<std::string, SimulatedAgent> agents_;  // by session id
  int under_way_ = 0;
  LoadReport report_;
};

}  // namespace spikeserve

#endif  // LOADTEST_CALLER_H_
