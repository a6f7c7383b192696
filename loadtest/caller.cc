#include "loadtest/caller.h"

#include <utility>

#include "absl/time/clock.h"
#include "client/retry.h"

namespace spikeserve {
namespace {

using std::chrono::steady_clock;

// Keeps a server that refuses everything from being flooded.
constexpr absl::Duration kPauseAfterError = absl::Milliseconds(10);

double Seconds(steady_clock::duration duration) {
  return std::chrono::duration<double>(duration).count();
}

}  // namespace

Caller::Caller(std::unique_ptr<Exchange> exchange, std::vector<SimulatedAgent> agents)
    : exchange_(std::move(exchange)) {
  for (SimulatedAgent& agent : agents) {
    std::string id = agent.session_id();
    agents_.emplace(std::move(id), std::move(agent));
  }
}

LoadReport Caller::Run(steady_clock::duration duration) {
  const auto start = steady_clock::now();
  end_ = start + duration;
  for (auto& [id, agent] : agents_) Send(agent);
  while (under_way_ > 0) {
    const auto reply = exchange_->Receive();
    if (!reply.ok()) {
      for (; under_way_ > 0; --under_way_) report_.CountError(reply.status());
      break;
    }
    TakeReply(*reply);
  }
  report_.seconds = Seconds(steady_clock::now() - start);
  return report_;
}

void Caller::Send(SimulatedAgent& agent) {
  agent.sent = steady_clock::now();
  if (agent.sent >= end_) return;
  if (absl::Status status = exchange_->Send(agent.request()); !status.ok()) {
    report_.CountError(status);
    return;
  }
  ++under_way_;
}

void Caller::TakeReply(const ActReply& reply) {
  --under_way_;
  SimulatedAgent& agent = agents_.at(reply.session_id);
  if (!reply.response.ok()) {
    report_.CountError(reply.response.status());
    if (!IsRetryable(reply.response.status())) return;
    absl::SleepFor(kPauseAfterError);
  } else {
    report_.latency.Add(Seconds(reply.arrived - agent.sent));
    ++report_.decisions;
    if (absl::Status status = agent.Accept(*reply.response); !status.ok()) {
      report_.CountError(status);
      return;
    }
  }
  Send(agent);
}

absl::Status Caller::CloseSessions() {
  absl::Status first_error;
  for (auto& [id, agent] : agents_) first_error.Update(agent.Close());
  return first_error;
}

}  // namespace spikeserve
