#include "loadtest/caller.h"

#include <algorithm>
#include <utility>

#include "absl/time/clock.h"
#include "spikeserve/retry.h"
#include "spikeserve/status.h"

namespace spikeserve {
namespace {

using std::chrono::steady_clock;

// Returns whether the server misses decisions, which SimulatedAgent::Resume sends again.
bool IsBehind(const absl::Status& status) { return ExpectedDecision(status).has_value(); }

// Returns whether the same request may succeed later. RESOURCE_EXHAUSTED counts as transient,
// because a rate limit allows requests again after a pause. OUT_OF_RANGE is the end of a stream.
bool IsTransient(const absl::Status& status) {
  return IsRetryable(status) || absl::IsResourceExhausted(status) || absl::IsOutOfRange(status);
}

double Seconds(steady_clock::duration duration) {
  return std::chrono::duration<double>(duration).count();
}

}  // namespace

Caller::Caller(std::unique_ptr<Exchange> exchange, std::vector<SimulatedAgent> agents,
               const RetryOptions& retry, absl::Duration pause_after_error, absl::Duration patience)
    : exchange_(std::move(exchange)),
      retry_(&retry),
      pause_after_error_(pause_after_error),
      patience_(patience) {
  for (SimulatedAgent& agent : agents) {
    agents_.push_back(std::make_unique<SimulatedAgent>(std::move(agent)));
    by_session_.emplace(agents_.back()->session_id(), agents_.back().get());
  }
}

LoadReport Caller::RunClosedLoop(steady_clock::duration duration) {
  const Time start = steady_clock::now();
  const Time end = start + duration;
  for (const auto& agent : agents_) Send(*agent, steady_clock::now());
  while (!in_flight_.empty() || (!stalled_.empty() && steady_clock::now() < end)) {
    const bool resumes = steady_clock::now() < end;
    if (resumes && !stalled_.empty()) ResumeStalled();
    if (in_flight_.empty()) continue;
    const bool is_pause = resumes && !stalled_.empty();
    const auto reply = exchange_->Receive(is_pause ? pause_after_error_ : patience_);
    if (!reply.ok()) {
      if (is_pause && absl::IsDeadlineExceeded(reply.status())) continue;
      FailRequestsInFlight(reply.status());
      continue;
    }
    SimulatedAgent* agent = TakeReply(*reply, end);
    const Time now = steady_clock::now();
    if (agent != nullptr && now < end) Send(*agent, now);
  }
  return FinishReport(start);
}

LoadReport Caller::RunAtRate(const RequestSchedule& schedule, steady_clock::duration duration) {
  const Time start = steady_clock::now();
  const Time end = start + duration;
  std::deque<SimulatedAgent*> free;
  for (const auto& agent : agents_) free.push_back(agent.get());
  Time next = start + schedule.offset;  // due time of the next request to send
  while (!in_flight_.empty() || (next < end && !(free.empty() && stalled_.empty()))) {
    if (!stalled_.empty() && next < end) ResumeStalled();
    while (next < end && next <= steady_clock::now() && !free.empty()) {
      Send(*free.front(), next);
      free.pop_front();
      next += schedule.interval;
    }
    const bool waits_for_time = next < end && !(free.empty() && stalled_.empty());
    auto pause = waits_for_time ? absl::FromChrono(next - steady_clock::now()) : patience_;
    if (waits_for_time && !stalled_.empty()) pause = std::min(pause, pause_after_error_);
    if (in_flight_.empty()) {
      absl::SleepFor(pause);
      continue;
    }
    const auto reply = exchange_->Receive(pause);
    if (reply.ok()) {
      if (SimulatedAgent* agent = TakeReply(*reply, end)) free.push_back(agent);
    } else if (!waits_for_time || !absl::IsDeadlineExceeded(reply.status())) {
      FailRequestsInFlight(reply.status());
    }
  }
  return FinishReport(start);
}

void Caller::Send(SimulatedAgent& agent, Time due) {
  agent.due = due;
  if (absl::Status status = exchange_->Send(agent.request()); !status.ok()) {
    Fail(agent, status);
    return;
  }
  in_flight_.insert(&agent);
}

SimulatedAgent* Caller::TakeReply(const ActReply& reply, Time end) {
  SimulatedAgent& agent = *by_session_.at(reply.session_id);
  in_flight_.erase(&agent);
  if (!reply.response.ok()) {
    const absl::Status& status = reply.response.status();
    if (!IsTransient(status)) {
      Fail(agent, status);
      return nullptr;
    }
    if (auto pause = PauseAfter(status, agent); pause > absl::ZeroDuration()) absl::SleepFor(pause);
    if (steady_clock::now() < end) Send(agent, agent.due);
    return nullptr;
  }
  agent.retries.reset();
  const double waited = Seconds(reply.arrived - agent.due);
  report_.latency.Add(waited);
  agent.longest_wait = std::max(agent.longest_wait, waited);
  ++report_.decisions;
  if (absl::Status status = agent.Accept(*reply.response); !status.ok()) {
    Fail(agent, status);
    return nullptr;
  }
  return &agent;
}

absl::Duration Caller::PauseAfter(const absl::Status& error, SimulatedAgent& agent) {
  if (!agent.retries.has_value()) agent.retries.emplace(*retry_, agent.session_id());
  if (const auto delay = agent.retries->DelayAfter(error)) return *delay;
  agent.retries.reset();
  report_.CountError(error);
  return pause_after_error_;
}

void Caller::Fail(SimulatedAgent& agent, const absl::Status& error) {
  if (!IsBehind(error)) report_.CountError(error);
  const bool lost = IsSessionLost(error) && agent.reopens();
  if (lost || IsBehind(error) || IsTransient(error)) stalled_.push_back({&agent, error});
}

void Caller::FailRequestsInFlight(const absl::Status& status) {
  for (SimulatedAgent* agent : std::exchange(in_flight_, {})) Fail(*agent, status);
}

void Caller::ResumeStalled() {
  absl::SleepFor(pause_after_error_);
  if (in_flight_.empty()) exchange_->Reset();
  for (const auto& [agent, error] : std::exchange(stalled_, {})) {
    const std::string before = agent->session_id();
    const absl::Status status = agent->Resume(error);
    by_session_.erase(before);
    by_session_[agent->session_id()] = agent;
    if (status.ok()) {
      Send(*agent, agent->due);
      continue;
    }
    report_.CountError(status);
    // A session that is lost stays lost until a new one is open.
    if (IsTransient(status)) stalled_.push_back({agent, IsSessionLost(error) ? error : status});
    if (IsBehind(status) || IsSessionLost(status)) stalled_.push_back({agent, status});
  }
}

LoadReport Caller::FinishReport(Time start) {
  report_.seconds = Seconds(steady_clock::now() - start);
  for (const auto& agent : agents_) report_.longest.Add(agent->longest_wait);
  return report_;
}

absl::Status Caller::CloseSessions() {
  absl::Status first_error;
  for (const auto& agent : agents_) {
    const absl::Status status = agent->Close();
    first_error.Update(status);
    if (IsRetryable(status)) break;  // the server is gone, and its sessions with it
  }
  return first_error;
}

}  // namespace spikeserve
