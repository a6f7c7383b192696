// One caller of a load test: sends the requests of its agents over one exchange and measures the
// answers.
//
// In a closed loop every agent has one request in flight and sends the next one when it has the
// answer. At a fixed rate, requests are due on a schedule, and each is sent as soon as an agent is
// free. Its latency is measured from the time it was due. A server that stalls is therefore charged
// for all requests that had to wait, not only for those in flight (this avoids "coordinated
// omission").
//
// After a transient error an agent pauses and repeats the request, whose latency still counts from
// the time it was first due. Such an error counts if the client library would not repeat the call.
// If the connection breaks, the caller connects again; agents whose session was lost open a new
// one. A server that misses decisions of a session gets them again, which is no error. After any
// other error an agent sends no more requests.
//
// Not thread-safe; each caller runs on its own thread.
#pragma once

#include <chrono>
#include <deque>
#include <memory>
#include <string>
#include <unordered_map>
#include <unordered_set>
#include <vector>

#include "absl/time/time.h"
#include "loadtest/exchange.h"
#include "loadtest/load_report.h"
#include "loadtest/simulated_agent.h"
#include "spikeserve/retry.h"

namespace spikeserve {

// The times at which requests are due: the first one after `offset`, then one every `interval`.
struct RequestSchedule {
  std::chrono::steady_clock::duration offset;
  std::chrono::steady_clock::duration interval;
};

class Caller {
 public:
  // `retry` must outlive the caller. `pause_after_error` protects a server that refuses every
  // request from being flooded. `patience` limits the wait for an answer; it must exceed the
  // timeout of a call, so that it expires only if the server no longer answers at all.
  Caller(std::unique_ptr<Exchange> exchange, std::vector<SimulatedAgent> agents,
         const RetryOptions& retry, absl::Duration pause_after_error, absl::Duration patience);

  // Each of these sends requests for `duration`, waits for the outstanding answers and returns the
  // measurements.
  LoadReport RunClosedLoop(std::chrono::steady_clock::duration duration);
  LoadReport RunAtRate(const RequestSchedule& schedule,
                       std::chrono::steady_clock::duration duration);

  // Closes the sessions of all agents and returns the first error.
  absl::Status CloseSessions();

 private:
  using Time = std::chrono::steady_clock::time_point;

  void Send(SimulatedAgent& agent, Time due);
  // An agent that has to be resumed after an error before it can send.
  struct Stalled {
    SimulatedAgent* agent;
    absl::Status error;
  };

  // Records an answer. Returns the agent that may send its next request, or null if it may not send
  // yet, or not any more. A request that failed is repeated before `end`.
  SimulatedAgent* TakeReply(const ActReply& reply, Time end);
  // Returns the pause before the request of `agent`, which failed with `error`, is repeated. Counts
  // an error that the client library would not repeat.
  absl::Duration PauseAfter(const absl::Status& error, SimulatedAgent& agent);
  // Counts `error`, unless the server misses decisions. Stalls `agent` if it can be resumed.
  void Fail(SimulatedAgent& agent, const absl::Status& error);
  // Counts every request in flight as failed with `status`.
  void FailRequestsInFlight(const absl::Status& status);
  // Resumes the stalled agents after a pause and repeats their requests.
  void ResumeStalled();
  // Returns the measurements of a run that began at `start`.
  LoadReport FinishReport(Time start);

  std::unique_ptr<Exchange> exchange_;
  const RetryOptions* retry_;
  absl::Duration pause_after_error_;
  absl::Duration patience_;
  std::vector<std::unique_ptr<SimulatedAgent>> agents_;
  std::unordered_map<std::string, SimulatedAgent*> by_session_;  // by session id
  std::unordered_set<SimulatedAgent*> in_flight_;                // agents that wait for an answer
  std::vector<Stalled> stalled_;
  LoadReport report_;
};

}  // namespace spikeserve
