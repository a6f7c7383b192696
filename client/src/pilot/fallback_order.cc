#include "client/src/pilot/fallback_order.h"

#include <algorithm>
#include <utility>

namespace spikeserve::piloting {
namespace {

// Returns whether the actions of `source` are the server's.
bool IsServers(ActionSource source) {
  return source == ActionSource::kFresh || source == ActionSource::kHeld;
}

}  // namespace

FallbackOrder::FallbackOrder(ActionShape shape, const ActionValue& neutral, int hold_beats,
                             absl::Duration oldest_held, int ramp_beats, absl::Duration now)
    : shape_(std::move(shape)),
      neutral_(neutral),
      hold_beats_(hold_beats),
      oldest_held_(oldest_held),
      ramp_beats_(ramp_beats),
      last_(neutral),
      observed_at_(now),
      ramp_from_(neutral) {
  BeginEpisode();
}

void FallbackOrder::BeginEpisode() {
  last_.Assign(neutral_.view());
  can_hold_ = false;
  ramped_ = ramp_beats_;
}

void FallbackOrder::TakeFresh(const ActionView& action, absl::Duration observed_at) {
  last_.Assign(action);
  observed_at_ = observed_at;
  held_ = 0;
  can_hold_ = true;
  Enter(ActionSource::kFresh);
}

bool FallbackOrder::Hold(absl::Duration now) {
  if (!can_hold_ || held_ >= hold_beats_ || now - observed_at_ > oldest_held_) {
    can_hold_ = false;
    return false;
  }
  ++held_;
  Enter(ActionSource::kHeld);
  return true;
}

void FallbackOrder::TakeLocal(const ActionView& action, absl::Duration observed_at) {
  last_.Assign(action);
  observed_at_ = observed_at;
  Enter(ActionSource::kLocal);
}

bool FallbackOrder::Ramp() {
  if (source_ != ActionSource::kSafe) ramp_from_.Assign(last_.view());
  ramped_ = std::min(ramped_, ramp_beats_) + 1;
  if (ramped_ > ramp_beats_ || !shape_.is_box()) return false;
  const float share = static_cast<float>(ramped_) / static_cast<float>(ramp_beats_);
  for (size_t i = 0; i < shape_.size(); ++i) {
    const float from = ramp_from_.continuous[i];
    last_.continuous[i] = from + share * (neutral_.continuous[i] - from);
  }
  Enter(ActionSource::kSafe);
  return true;
}

void FallbackOrder::TakeSafe(const ActionView& action) {
  last_.Assign(action);
  Enter(ActionSource::kSafe);
}

void FallbackOrder::Enter(ActionSource source) {
  if (source != ActionSource::kSafe) ramped_ = 0;
  if (source_ != source) {
    ++entries_[static_cast<size_t>(source)];
    if (source_.has_value() && !(IsServers(*source_) && IsServers(source))) {
      changes_[noted_++ % changes_.size()] = {*source_, source, source_beats_};
    }
    source_ = source;
    source_beats_ = 0;
  }
  ++source_beats_;
}

std::optional<SourceChange> FallbackOrder::TakeChange() {
  if (!has_change()) return std::nullopt;
  if (noted_ - taken_ > changes_.size()) taken_ = noted_ - changes_.size();
  return changes_[taken_++ % changes_.size()];
}

}  // namespace spikeserve::piloting
