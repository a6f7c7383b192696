#include "core/robot/step_log.h"

#include <algorithm>
#include <utility>

namespace spikeserve::robot {
namespace {

constexpr size_t kMostEpisodes = 4096;  // whose ends the server may miss
constexpr size_t kMostSkipped = 65536;  // rewards of one request
constexpr size_t kOperatorBytes = 1 + kLongestOperatorId;
constexpr uint64_t kMostBytes = 1ULL << 20;  // of the history in one request

// Returns memory that the kernel provides when it is first used.
template <typename T>
std::unique_ptr<T[]> Reserve(size_t count) {
  return std::make_unique_for_overwrite<T[]>(count);
}

}  // namespace

StepLog::StepLog(size_t kept, size_t observation_size, const ActionShape& shape)
    : kept_(kept + 1),
      reward_slots_(kept_ + kMostSkipped),
      observation_size_(observation_size),
      shape_(shape),
      observations_(Reserve<float>(kept_ * observation_size)),
      continuous_(Reserve<float>(kept_ * shape.size())),
      discrete_(std::make_unique<int64_t[]>(kept_)),
      choosers_(std::make_unique<Chooser[]>(kept_)),
      operators_(Reserve<char>(kept_ * kOperatorBytes)),
      rewards_(Reserve<double>(reward_slots_)),
      is_blind_(kept_) {
  episodes_.emplace_back();
}

bool StepLog::is_one_behind() const {
  return !is_ending() && episodes_.size() == settled_ + 2 && FitsOne();
}

const Episode* StepLog::Find(int64_t index) const {
  const int64_t offset = index - oldest().index;
  const auto size = static_cast<int64_t>(episodes_.size() - settled_);
  return offset < 0 || offset >= size ? nullptr
                                      : &episodes_[settled_ + static_cast<size_t>(offset)];
}

bool StepLog::is_too_long() const {
  return episodes_.size() - settled_ > kMostEpisodes || acknowledged_ < rewards_from();
}

uint64_t StepLog::kept_from() const { return std::max(base_, next_ > kept_ ? next_ - kept_ : 0); }

uint64_t StepLog::kept_from(const Episode& episode) const {
  const size_t outside = episode.has_ended() ? episode.last.size() : 1;
  return std::min(kept_from(), episode.past() - outside);
}

uint64_t StepLog::rewards_from() const {
  return std::max(base_, next_ > reward_slots_ ? next_ - reward_slots_ : 0);
}

uint64_t StepLog::most() const {
  const uint64_t bytes = 4 * observation_size_ + 64;  // of a step on the wire
  return std::max<uint64_t>(2, std::min(history_limit_, kMostBytes / bytes));
}

bool StepLog::FitsDatagram() const {
  // Upper bounds of what is written: the 1,167 bytes of a payload begin with the number of the
  // request; a message has its session, numbers, a report and a trace; a step has a reward, a
  // number and a source.
  constexpr uint64_t kPayload = 1159, kMessage = 240, kStep = 26;
  const uint64_t action = 4 * shape_.size() + 8;
  const uint64_t begin = HistoryBegin();
  const uint64_t skipped = begin - std::min(begin, std::max(acknowledged_, asked().first));
  const uint64_t steps = HistoryPast() - begin;
  const uint64_t request =
      kMessage + 9 * skipped + (steps + 1) * (kStep + 4 * observation_size_ + action);
  return request <= kPayload;
}

uint64_t StepLog::Add(std::span<const float> observation, double reward, Time observed_at,
                      std::string_view traceparent) {
  const uint64_t number = next_++;
  if (kept_from() > 0 && kept_from() - 1 >= acknowledged_ && kept_from() > base_) ++dropped_;
  const size_t slot = SlotOf(number);
  is_blind_[slot] = observation.empty();
  std::copy(observation.begin(), observation.end(), observations_.get() + slot * observation_size_);
  rewards_[number % reward_slots_] = reward;
  observed_at_ = observed_at;
  traceparent_.assign(traceparent.data(), traceparent.size());
  Episode& running = episodes_.back();
  if (running.steps++ > 0) running.rewards += reward;
  return number;
}

void StepLog::SetExecuted(const ActionView& action, const ChooserView& chooser) {
  const size_t slot = SlotOf(next_ - 1);
  discrete_[slot] = action.discrete;
  std::copy(action.continuous.begin(), action.continuous.end(),
            continuous_.get() + slot * shape_.size());
  choosers_[slot] = chooser.kind;
  if (chooser.kind != Chooser::kOperator) return;
  char* const name = operators_.get() + slot * kOperatorBytes;
  name[0] = static_cast<char>(chooser.operator_id.size());
  std::copy(chooser.operator_id.begin(), chooser.operator_id.end(), name + 1);
}

ChooserView StepLog::ChooserOf(size_t slot) const {
  const Chooser kind = choosers_[slot];
  if (kind != Chooser::kOperator) return {.kind = kind};
  const char* const name = operators_.get() + slot * kOperatorBytes;
  return {.kind = kind, .operator_id = {name + 1, static_cast<unsigned char>(name[0])}};
}

StepView StepLog::At(uint64_t number) const {
  const size_t slot = SlotOf(number);
  const size_t size = is_blind_[slot] ? 0 : observation_size_;
  return {.observation = {observations_.get() + slot * observation_size_, size},
          .reward = RewardOf(number),
          .executed = {.discrete = shape_.is_box() ? 0 : discrete_[slot],
                       .continuous = {continuous_.get() + slot * shape_.size(), shape_.size()}},
          .chooser = ChooserOf(slot)};
}

StepView StepLog::StepOf(const Episode& episode, uint64_t number) const {
  if (Has(number)) return At(number);
  const KeptStep& step = episode.last[number + episode.last.size() - episode.past()];
  return {step.observation, step.reward, step.executed.view(), step.chooser.view()};
}

uint64_t StepLog::End(Outcome outcome) {
  Episode& episode = episodes_.back();
  episode.state = EpisodeState::kEnded;
  episode.outcome = std::move(outcome);
  for (uint64_t number = next_ - std::min<uint64_t>(2, episode.steps); number < next_; ++number) {
    const StepView step = At(number);
    KeptStep& kept = episode.last.emplace_back();
    kept.observation.assign(step.observation.begin(), step.observation.end());
    kept.reward = step.reward;
    kept.executed.Assign(step.executed);
    kept.chooser.Assign(step.chooser);
  }
  const uint64_t serial = episode.serial;
  episodes_.push_back({.serial = serial + 1, .index = episode.index + 1, .first = episode.past()});
  return serial;
}

uint64_t StepLog::HistoryBegin() const {
  const Episode& episode = asked();
  // The executed action of the last step that the server has may be missing there.
  const uint64_t expected = std::min(acknowledged_, HistoryPast());
  uint64_t begin = std::max(episode.first, expected > 0 ? expected - 1 : 0);
  if (kept_from(episode) > begin) {
    begin = kept_from(episode);
    if (begin == acknowledged_) ++begin;  // the context starts behind what is not known
  }
  if (HistoryPast() - begin <= most()) return begin;
  // The server takes steps without an observation only with what follows them, so that a history
  // of these alone would bring nothing. They count as rewards all the same.
  const uint64_t last = std::min(episode.past() - 1, acknowledged_ + kMostSkipped);
  uint64_t seen = std::max(begin, acknowledged_);
  while (seen < last && StepOf(episode, seen).observation.empty()) ++seen;
  return seen > acknowledged_ ? seen : begin;
}

Request StepLog::NextRequest() const {
  const Episode& episode = asked();
  const uint64_t newest = HistoryPast();
  Request request = {.episode = &episode};
  request.begin = HistoryBegin();
  request.end = std::min(newest, request.begin + most());
  request.decision = request.end - base_;
  request.skipped = std::min(std::max(acknowledged_, episode.first), request.begin);
  if (request.end < newest || episode.has_ended()) return request;
  request.asks = !At(newest).observation.empty();
  request.observed_at = observed_at_;
  request.traceparent = traceparent_;
  return request;
}

void StepLog::Acknowledge(int64_t next_step) {
  const uint64_t next = oldest().first + static_cast<uint64_t>(std::max<int64_t>(next_step, 0));
  acknowledged_ = std::max(acknowledged_, std::min(next, oldest().past()));
}

bool StepLog::Rewind(uint64_t decision, std::optional<int64_t> episode) {
  const uint64_t number = NumberOf(decision);
  while (settled_ > 0 &&
         (number < oldest().first || episode.value_or(oldest().index) < oldest().index)) {
    AbandonEnd();
    episodes_[--settled_].state = EpisodeState::kEnded;
  }
  if (number < std::max(oldest().first, rewards_from()) || number > oldest().past()) return false;
  acknowledged_ = number;
  return true;
}

void StepLog::Settle(bool is_stored) {
  acknowledged_ = std::max(acknowledged_, oldest().past());
  episodes_[settled_++].state = EpisodeState::kSettled;
  while (settled_ > (is_stored ? kMostEpisodes : 0)) {
    episodes_.pop_front();
    --settled_;
  }
}

void StepLog::ForgetDurable(uint64_t decisions, int64_t episodes) {
  while (settled_ > 0 &&
         (episodes_.front().index < episodes || episodes_.front().past() < NumberOf(decisions))) {
    episodes_.pop_front();
    --settled_;
  }
}

void StepLog::BeginAgain(bool keeps_steps) {
  lost_episodes_ += episodes_.size() - settled_ - 1;
  settled_ = 0;
  episodes_.erase(episodes_.begin(), episodes_.end() - 1);
  Episode& running = episodes_.front();
  const uint64_t begin = keeps_steps ? std::max(running.first, rewards_from()) : next_;
  running = {.serial = running.serial,
             .first = begin,
             .steps = next_ - begin,
             .lost_steps = running.lost_steps + (begin - running.first)};
  for (uint64_t number = begin + 1; number < next_; ++number) running.rewards += RewardOf(number);
  base_ = acknowledged_ = begin;
}

}  // namespace spikeserve::robot
