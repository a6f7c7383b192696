#include "client/src/pilot/beat_log.h"

#include <algorithm>
#include <utility>

namespace spikeserve::piloting {
namespace {

constexpr size_t kMostEpisodes = 64;         // whose ends the server may miss
constexpr size_t kMostSkipped = 65536;       // rewards of one request
constexpr uint64_t kMostBytes = 1ULL << 20;  // of the history in one request

// Returns memory that the kernel provides when it is first used.
template <typename T>
std::unique_ptr<T[]> Reserve(size_t count) {
  return std::make_unique_for_overwrite<T[]>(count);
}

}  // namespace

BeatLog::BeatLog(size_t kept, size_t observation_size, const ActionShape& shape)
    : kept_(kept + 1),
      reward_slots_(kept_ + kMostSkipped),
      observation_size_(observation_size),
      shape_(shape),
      observations_(Reserve<float>(kept_ * observation_size)),
      continuous_(Reserve<float>(kept_ * shape.size())),
      discrete_(std::make_unique<int64_t[]>(kept_)),
      rewards_(Reserve<double>(reward_slots_)),
      is_blind_(kept_) {
  episodes_.emplace_back();
}

const RobotEpisode* BeatLog::Find(int64_t index) const {
  const int64_t offset = index - oldest().index;
  const auto size = static_cast<int64_t>(episodes_.size());
  return offset < 0 || offset >= size ? nullptr : &episodes_[static_cast<size_t>(offset)];
}

bool BeatLog::is_complete() const {
  return oldest().ending.has_value() && acknowledged_ >= oldest().past();
}

bool BeatLog::is_too_long() const {
  return episodes_.size() > kMostEpisodes || acknowledged_ < rewards_from();
}

uint64_t BeatLog::kept_from() const { return std::max(base_, next_ > kept_ ? next_ - kept_ : 0); }

uint64_t BeatLog::kept_from(const RobotEpisode& episode) const {
  const size_t outside = episode.ending.has_value() ? episode.ending->last.size() : 1;
  return std::min(kept_from(), episode.past() - outside);
}

uint64_t BeatLog::rewards_from() const {
  return std::max(base_, next_ > reward_slots_ ? next_ - reward_slots_ : 0);
}

uint64_t BeatLog::most() const {
  const uint64_t bytes = 4 * observation_size_ + 64;  // of a beat on the wire
  return std::max<uint64_t>(2, std::min(history_limit_, kMostBytes / bytes));
}

uint64_t BeatLog::Add(absl::Span<const float> observation, double reward, int64_t observed_at,
                      absl::string_view traceparent) {
  const uint64_t number = next_++;
  if (kept_from() > 0 && kept_from() - 1 >= acknowledged_ && kept_from() > base_) ++dropped_;
  const size_t slot = SlotOf(number);
  is_blind_[slot] = observation.empty();
  std::copy(observation.begin(), observation.end(), observations_.get() + slot * observation_size_);
  rewards_[number % reward_slots_] = reward;
  observed_at_ = observed_at;
  traceparent_.assign(traceparent.data(), traceparent.size());
  ++episodes_.back().steps;
  return number;
}

void BeatLog::SetExecuted(const ActionView& action) {
  const size_t slot = SlotOf(next_ - 1);
  discrete_[slot] = action.discrete;
  std::copy(action.continuous.begin(), action.continuous.end(),
            continuous_.get() + slot * shape_.size());
}

BeatView BeatLog::At(uint64_t number) const {
  const size_t slot = SlotOf(number);
  const size_t size = is_blind_[slot] ? 0 : observation_size_;
  return {.observation = {observations_.get() + slot * observation_size_, size},
          .reward = RewardOf(number),
          .executed = {.discrete = shape_.is_box() ? 0 : discrete_[slot],
                       .continuous = {continuous_.get() + slot * shape_.size(), shape_.size()}}};
}

BeatView BeatLog::BeatOf(const RobotEpisode& episode, uint64_t number) const {
  if (Has(number)) return At(number);
  const std::vector<KeptBeat>& last = episode.ending->last;
  const KeptBeat& beat = last[number + last.size() - episode.past()];
  return {beat.observation, beat.reward, beat.executed.view()};
}

std::future<absl::StatusOr<v1::EndEpisodeResponse>> BeatLog::End(EpisodeOutcome outcome) {
  RobotEpisode& episode = episodes_.back();
  Ending& ending = episode.ending.emplace();
  ending.outcome = std::move(outcome);
  for (uint64_t number = next_ - std::min<uint64_t>(2, episode.steps); number < next_; ++number) {
    const BeatView beat = At(number);
    KeptBeat& kept = ending.last.emplace_back();
    kept.observation.assign(beat.observation.begin(), beat.observation.end());
    kept.reward = beat.reward;
    kept.executed.Assign(beat.executed);
  }
  auto summary = ending.summary.get_future();
  episodes_.push_back({.index = episode.index + 1, .first = episode.past()});
  return summary;
}

uint64_t BeatLog::HistoryBegin() const {
  const RobotEpisode& episode = asked();
  // The executed action of the last beat that the server has may be missing there.
  const uint64_t expected = std::min(acknowledged_, HistoryPast());
  uint64_t begin = std::max(episode.first, expected > 0 ? expected - 1 : 0);
  if (kept_from(episode) > begin) {
    begin = kept_from(episode);
    if (begin == acknowledged_) ++begin;  // the context starts behind what is not known
  }
  if (HistoryPast() - begin <= most()) return begin;
  // The server takes beats without an observation only with what follows them, so that a history
  // of these alone would bring nothing. They count as rewards all the same.
  const uint64_t last = std::min(episode.past() - 1, acknowledged_ + kMostSkipped);
  uint64_t seen = std::max(begin, acknowledged_);
  while (seen < last && BeatOf(episode, seen).observation.empty()) ++seen;
  return seen > acknowledged_ ? seen : begin;
}

uint64_t BeatLog::HistoryPast() const {
  return asked().past() - (asked().ending.has_value() ? 0 : 1);
}

bool BeatLog::FitsOne() const { return HistoryPast() - HistoryBegin() <= most(); }

void BeatLog::FillRequest(v1::ActRequest* request) const {
  const RobotEpisode& episode = asked();
  const uint64_t newest = HistoryPast();
  const uint64_t begin = HistoryBegin();
  const uint64_t end = std::min(newest, begin + most());
  request->set_step(static_cast<int64_t>(end - episode.first));
  request->set_decision(end - base_);
  for (uint64_t number = begin; number < end; ++number) {
    const BeatView beat = BeatOf(episode, number);
    v1::Beat* message = request->add_history();
    message->set_step(static_cast<int64_t>(number - episode.first));
    message->mutable_observation()->Assign(beat.observation.begin(), beat.observation.end());
    message->set_reward(beat.reward);
    ToProto(beat.executed, shape_, message->mutable_executed());
  }
  for (uint64_t number = std::max(acknowledged_, episode.first); number < begin; ++number) {
    request->add_skipped_rewards(RewardOf(number));
  }
  if (end < newest || episode.ending.has_value()) return;
  const BeatView beat = At(newest);
  if (beat.observation.empty()) return;
  request->mutable_observation()->Assign(beat.observation.begin(), beat.observation.end());
  request->set_reward(beat.reward);
  request->set_observed_at(observed_at_);
  request->set_traceparent(traceparent_);
}

void BeatLog::FillEnd(v1::EndEpisodeRequest* request) const {
  const RobotEpisode& episode = oldest();
  const Ending& ending = *episode.ending;
  const EpisodeOutcome& outcome = ending.outcome;
  request->set_reward(outcome.reward);
  request->set_terminated(outcome.terminated);
  request->set_truncated(outcome.truncated);
  if (outcome.target_return.has_value()) request->set_target_return(*outcome.target_return);
  request->mutable_observation()->Assign(outcome.observation.begin(), outcome.observation.end());
  ToProto(ending.last.back().executed.view(), shape_, request->mutable_executed_action());
  request->set_episode(episode.index);
  request->set_steps(static_cast<int64_t>(episode.steps));
}

void BeatLog::Acknowledge(int64_t next_step) {
  const uint64_t next = oldest().first + static_cast<uint64_t>(std::max<int64_t>(next_step, 0));
  acknowledged_ = std::max(acknowledged_, std::min(next, oldest().past()));
}

bool BeatLog::Rewind(uint64_t decision, std::optional<int64_t> episode) {
  const uint64_t number = NumberOf(decision);
  while (!settled_.empty() &&
         (number < oldest().first || episode.value_or(oldest().index) < oldest().index)) {
    is_ending_ = false;
    episodes_.push_front(std::move(settled_.back()));
    settled_.pop_back();
  }
  if (number < std::max(oldest().first, rewards_from()) || number > oldest().past()) return false;
  acknowledged_ = number;
  return true;
}

Ending BeatLog::Settle(bool is_stored) {
  Ending ending = *std::move(episodes_.front().ending);
  acknowledged_ = std::max(acknowledged_, oldest().past());
  is_ending_ = false;
  if (is_stored) {
    settled_.push_back(std::move(episodes_.front()));
    settled_.back().ending = {.outcome = ending.outcome,
                              .summary = {},  // nobody waits for the next answer
                              .last = ending.last};
    if (settled_.size() > kMostEpisodes) settled_.pop_front();
  }
  episodes_.pop_front();
  return ending;
}

void BeatLog::ForgetDurable(uint64_t decisions, int64_t episodes) {
  while (!settled_.empty() &&
         (settled_.front().index < episodes || settled_.front().past() < NumberOf(decisions))) {
    settled_.pop_front();
  }
}

std::vector<Ending> BeatLog::BeginAgain(bool keeps_beats) {
  std::vector<Ending> endings;
  while (episodes_.size() > 1) endings.push_back(Settle(/*is_stored=*/false));
  settled_.clear();
  RobotEpisode& running = episodes_.front();
  const uint64_t begin = keeps_beats ? std::max(running.first, rewards_from()) : next_;
  running = {.index = 0,
             .first = begin,
             .steps = next_ - begin,
             .lost_steps = running.lost_steps + (begin - running.first)};
  base_ = acknowledged_ = begin;
  lost_episodes_ += endings.size();
  return endings;
}

}  // namespace spikeserve::piloting
