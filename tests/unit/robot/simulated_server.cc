#include "tests/unit/robot/simulated_server.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <utility>

namespace spikeserve::robot {
namespace {

KnownStep KnownOf(const StepView& step) {
  KnownStep known = {.reward = step.reward, .executed = step.executed.discrete};
  if (!step.observation.empty()) known.observation = step.observation[0];
  return known;
}

}  // namespace

Message MessageOf(uint64_t session, const StepLog& log, const Request& request) {
  Message message = {.session = session,
                     .decision = request.decision,
                     .step = static_cast<uint64_t>(request.step()),
                     .observed_at = request.observed_at,
                     .ends = request.ends};
  for (uint64_t i = request.skipped; i < request.begin; ++i) {
    message.skipped.push_back(log.RewardOf(i));
  }
  for (uint64_t i = request.begin; i < request.end; ++i) {
    message.history.push_back(KnownOf(log.StepOf(*request.episode, i)));
  }
  if (request.asks) {
    message.newest = KnownOf(log.At(request.end));
    message.newest->executed = -1;
  }
  if (request.ends) {
    message.end_reward = log.oldest().outcome.reward;
    message.end_steps = log.oldest().steps;
    message.end_executed = log.oldest().last.back().executed.discrete;
  }
  return message;
}

double EndedEpisode::episode_return() const {
  double sum = end_reward;
  for (size_t i = 1; i < steps.size(); ++i) sum += steps[i].reward;
  return sum;
}

Opening SimulatedServer::Open() {
  session_ = {.id = ++opened_};
  is_intruded_ = false;
  waiting_.clear();
  stored_ = session_;
  return {.history_limit = kHistoryLimit, .is_stored = is_stored_};
}

Answer SimulatedServer::Expected() const {
  return {.error = Error{.kind = Failure::kConflict,
                         .message = "expected another step",
                         .text = "expected another step",
                         .expected_decision = session_.decisions(),
                         .expected_episode = static_cast<int64_t>(session_.ended.size())}};
}

Answer SimulatedServer::Act(const Message& message, bool is_old) {
  if (session_.id != message.session) {
    return {.error = Error{.kind = Failure::kNotFound, .message = "lost", .text = "lost"}};
  }
  const uint64_t first = message.decision - message.step;
  const bool is_repeated = !session_.ended.empty() && session_.ended.back()->first == first;
  if (message.ends && is_repeated && !is_old) return Finish(true);
  if (first == session_.first && Differs(message)) {
    EXPECT_TRUE(is_intruded_) << "a step is another one when it is sent again";
    return {.error = Error{.kind = Failure::kConflict, .message = "differs", .text = "differs"}};
  }
  if (first != session_.first || !Append(message)) return Expected();
  if (message.ends && !is_old) return End(message);
  Answer answer = Finish(false);
  answer.reply.next_step = static_cast<int64_t>(session_.steps.size());
  if (message.newest.has_value()) {
    answer.reply.action = {.discrete = static_cast<int64_t>(*message.newest->observation)};
    answer.reply.observed_at = message.observed_at;
  }
  return answer;
}

// Returns whether a step is another one than was taken.
bool SimulatedServer::Differs(const Message& message) const {
  const uint64_t begin = message.decision - message.history.size();
  for (uint64_t number = std::max(begin, session_.first); number < session_.decisions(); ++number) {
    const bool is_newest = number == message.decision && message.newest.has_value();
    if (number >= message.decision && !is_newest) break;
    const KnownStep& old = session_.steps[number - session_.first];
    const KnownStep& sent = is_newest ? *message.newest : message.history[number - begin];
    if (old.reward != sent.reward) return true;
    if (old.observation.has_value() && old.observation != sent.observation) return true;
  }
  return false;
}

bool SimulatedServer::Append(const Message& message) {
  std::vector<KnownStep> news = message.history;
  EXPECT_LE(news.size(), kHistoryLimit);
  const uint64_t begin = message.decision - news.size();
  uint64_t known = session_.decisions();
  if (begin - message.skipped.size() > known) return false;
  // What follows a step without an observation makes it a step; until then it waits.
  const bool is_last = message.newest.has_value() || message.ends;
  while (!is_last && !news.empty() && !news.back().observation.has_value()) news.pop_back();
  if (message.newest.has_value()) news.push_back(*message.newest);
  // What was executed in the step before may be lost.
  if (is_stored_ && !session_.steps.empty() && begin >= known && message.skipped.empty() &&
      !news.empty()) {
    return false;
  }
  for (; known < begin; ++known) {
    const size_t i = known - (begin - message.skipped.size());
    session_.steps.push_back({.reward = message.skipped[i]});
  }
  for (size_t i = 0; i < news.size(); ++i) {
    const uint64_t decision = begin + i;
    if (decision < session_.first) continue;
    if (decision == session_.decisions()) {
      session_.steps.push_back(news[i]);
      continue;
    }
    KnownStep& old = session_.steps[decision - session_.first];
    if (news[i].executed >= 0) old.executed = news[i].executed;
  }
  return true;
}

Answer SimulatedServer::End(const Message& message) {
  const uint64_t first = message.decision - message.step;
  if (!session_.ended.empty() && session_.ended.back()->first == first) return Finish(true);
  if (session_.id != message.session || first != session_.first ||
      message.end_steps != session_.steps.size()) {
    return Expected();
  }
  session_.steps.back().executed = message.end_executed;
  session_.ended.push_back(std::make_shared<EndedEpisode>(
      EndedEpisode{session_.first, session_.steps, message.end_reward}));
  session_.first = session_.decisions();
  session_.steps.clear();
  return Finish(true);
}

Answer SimulatedServer::Finish(bool has_ended) {
  if (is_stored_) waiting_.push_back(session_);
  Answer answer = {.reply = {.durable_decision = stored_.decisions(),
                             .durable_episode = static_cast<int64_t>(stored_.ended.size()),
                             .has_ended = has_ended}};
  if (has_ended) answer.reply.episode_return = session_.ended.back()->episode_return();
  return answer;
}

void SimulatedServer::Store(size_t count) {
  for (; count > 0 && !waiting_.empty(); --count) {
    stored_ = std::move(waiting_.front());
    waiting_.pop_front();
  }
}

bool SimulatedServer::Intrude() {
  if (session_.id == 0) return false;
  session_.steps.push_back({.observation = -1.0f, .reward = -1.0, .executed = -1});
  return !std::exchange(is_intruded_, true);
}

void SimulatedServer::Kill() {
  waiting_.clear();
  session_ = is_stored_ ? stored_ : ServedSession();
}

}  // namespace spikeserve::robot
