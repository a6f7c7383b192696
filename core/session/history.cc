#include "core/session/history.h"

#include <algorithm>
#include <bit>
#include <cstdint>

#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

constexpr size_t kFirstObservation = 2;

}  // namespace

absl::Span<const float> History::observation(size_t i) const {
  SPIKESERVE_DCHECK_LT(i, size());
  return {row(i) + kFirstObservation, observation_size_};
}

Action History::action(size_t i) const {
  Action copy;
  action(i, &copy);
  return copy;
}

void History::action(size_t i, Action* action) const {
  SPIKESERVE_DCHECK_LT(i, size());
  const float* cells = row(i);
  action->discrete = std::bit_cast<int32_t>(cells[1]);
  action->continuous.assign(cells + kFirstObservation + observation_size_, cells + stride_);
}

Timestep History::at(size_t i) const {
  const absl::Span<const float> seen = observation(i);
  return {.return_to_go = return_to_go(i),
          .observation = {seen.begin(), seen.end()},
          .action = action(i)};
}

void History::Append(float return_to_go, absl::Span<const float> observation, const Action& action,
                     size_t limit) {
  SPIKESERVE_DCHECK_GE(limit, size_t{1});
  SPIKESERVE_DCHECK(empty() ||
                    (observation.size() == observation_size_ &&
                     stride_ == kFirstObservation + observation.size() + action.continuous.size()));
  if (empty()) {
    observation_size_ = observation.size();
    stride_ = kFirstObservation + observation.size() + action.continuous.size();
  }
  size_t row = oldest_;
  if (size() < limit) {
    // Until the ring is full, the newest timestep is the last row. Rotating restores this order if
    // an earlier call had a smaller limit.
    std::rotate(cells_.begin(), cells_.begin() + static_cast<ptrdiff_t>(oldest_ * stride_),
                cells_.end());
    oldest_ = 0;
    row = size();
    cells_.resize(cells_.size() + stride_);
  } else {
    oldest_ = (oldest_ + 1) % size();
  }
  float* cells = cells_.data() + row * stride_;
  cells[0] = return_to_go;
  std::copy(observation.begin(), observation.end(), cells + kFirstObservation);
  WriteAction(action, cells);
}

void History::ReplaceLastAction(const Action& action) {
  SPIKESERVE_DCHECK(!empty());
  SPIKESERVE_DCHECK_EQ(action.continuous.size(), stride_ - kFirstObservation - observation_size_);
  WriteAction(action, cells_.data() + begin_of(size() - 1));
}

void History::WriteAction(const Action& action, float* row) const {
  row[1] = std::bit_cast<float>(static_cast<int32_t>(action.discrete));
  std::copy(action.continuous.begin(), action.continuous.end(),
            row + kFirstObservation + observation_size_);
}

void History::Clear() {
  cells_.clear();
  oldest_ = 0;
}

bool operator==(const History& a, const History& b) {
  if (a.size() != b.size()) return false;
  for (size_t i = 0; i < a.size(); ++i) {
    if (a.at(i) != b.at(i)) return false;
  }
  return true;
}

}  // namespace spikeserve
