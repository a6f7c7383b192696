#include "loadtest/caller.h"

#include <utility>

#include "absl/time/clock.h"
#include "spikeserve/retry.h"

namespace spikeserve {
namespace {

using std::chrono::steady_clock;

// Returns whether the same request may succeed later. RESOURCE_EXHAUSTED counts as transient,
// because a rate limit allows requests again after a pause.
bool IsTransient(const absl::Status& status) {
  return IsRetryable(status) || absl::IsResourceExhausted(status);
}

double Seconds(steady_clock::duration duration) {
  return std::chrono::duration<double>(duration).count();
}

}  // namespace

Caller::Caller(std::unique_ptr<Exchange> exchange, std::vector<SimulatedAgent> agents,
               absl::Duration pause_after_error, absl::Duration patience)
    : exchange_(std::move(exchange)), pause_after_error_(pause_after_error), patience_(patience) {
  for (SimulatedAgent& agent : agents) {
    std::string id = agent.session_id();
    agents_.emplace(std::move(id), std::move(agent));
  }
}

LoadReport Caller::RunClosedLoop(steady_clock::duration duration) {
  const Time start = steady_clock::now();
  const Time end = start + duration;
  for (auto& [id, agent] : agents_) Send(agent, steady_clock::now());
  while (in_flight_ > 0) {
    const auto reply = exchange_->Receive(patience_);
    if (!reply.ok()) {
      FailRequestsInFlight(reply.status());
      break;
    }
    SimulatedAgent* agent = TakeReply(*reply);
    const Time now = steady_clock::now();
    if (agent != nullptr && now < end) Send(*agent, now);
  }
  report_.seconds = Seconds(steady_clock::now() - start);
  return report_;
}

LoadReport Caller::RunAtRate(const Schedule& schedule, steady_clock::duration duration) {
  const Time start = steady_clock::now();
  const Time end = start + duration;
  std::deque<SimulatedAgent*> free;
  for (auto& [id, agent] : agents_) free.push_back(&agent);
  Time next = start + schedule.offset;  // due time of the next request to send
  while (in_flight_ > 0 || (next < end && !free.empty())) {
    while (next < end && next <= steady_clock::now() && !free.empty()) {
      Send(*free.front(), next);
      free.pop_front();
      next += schedule.interval;
    }
    const bool waits_for_time = next < end && !free.empty();
    const auto pause = waits_for_time ? absl::FromChrono(next - steady_clock::now()) : patience_;
    if (in_flight_ == 0) {
      absl::SleepFor(pause);
      continue;
    }
    const auto reply = exchange_->Receive(pause);
    if (reply.ok()) {
      if (SimulatedAgent* agent = TakeReply(*reply)) free.push_back(agent);
    } else if (!waits_for_time || !absl::IsDeadlineExceeded(reply.status())) {
      FailRequestsInFlight(reply.status());
    }
  }
  report_.seconds = Seconds(steady_clock::now() - start);
  return report_;
}

void Caller::Send(SimulatedAgent& agent, Time due) {
  agent.due = due;
  if (absl::Status status = exchange_->Send(agent.request()); !status.ok()) {
    report_.CountError(status);
    return;
  }
  ++in_flight_;
}

SimulatedAgent* Caller::TakeReply(const ActReply& reply) {
  --in_flight_;
  SimulatedAgent& agent = agents_.at(reply.session_id);
  if (!reply.response.ok()) {
    report_.CountError(reply.response.status());
    if (!IsTransient(reply.response.status())) return nullptr;
    if (pause_after_error_ > absl::ZeroDuration()) absl::SleepFor(pause_after_error_);
    return &agent;
  }
  report_.latency.Add(Seconds(reply.arrived - agent.due));
  ++report_.decisions;
  if (absl::Status status = agent.Accept(*reply.response); !status.ok()) {
    report_.CountError(status);
    return nullptr;
  }
  return &agent;
}

void Caller::FailRequestsInFlight(const absl::Status& status) {
  for (; in_flight_ > 0; --in_flight_) report_.CountError(status);
}

absl::Status Caller::CloseSessions() {
  absl::Status first_error;
  for (auto& [id, agent] : agents_) first_error.Update(agent.Close());
  return first_error;
}

}  // namespace spikeserve
