// One caller of a load test: the closed loop of its agents over one exchange.
//
// Every agent has one request under way and sends its next when it has the answer. An agent whose
// request failed for no lasting reason repeats it after a pause; after any other error it is
// retired.
//
// Not thread-safe; runs on a thread of its own.
#ifndef LOADTEST_CALLER_H_
#define LOADTEST_CALLER_H_

#include <chrono>
#include <memory>
#include <string>
#include <unordered_map>
#include <vector>

#include "loadtest/exchange.h"
#include "loadtest/load_report.h"
#include "loadtest/simulated_agent.h"

namespace spikeserve {

class Caller {
 public:
  Caller(std::unique_ptr<Exchange> exchange, std::vector<SimulatedAgent> agents);

  // Sends requests for `duration`, then waits for the answers under way.
  LoadReport Run(std::chrono::steady_clock::duration duration);

  // Ends the sessions of all agents, retired ones too, and returns the first error.
  absl::Status CloseSessions();

 private:
  void Send(SimulatedAgent& agent);
  void TakeReply(const ActReply& reply);

  std::unique_ptr<Exchange> exchange_;
  std::unordered_map<std::string, SimulatedAgent> agents_;  // by session id
  std::chrono::steady_clock::time_point end_;               // no request starts later
  int under_way_ = 0;
  LoadReport report_;
};

}  // namespace spikeserve

#endif  // LOADTEST_CALLER_H_
