#include "core/robot/fallback_order.h"

#include <algorithm>
#include <utility>

namespace spikeserve::robot {
namespace {

// Returns whether the actions of `source` are the server's.
bool IsServers(Source source) { return source == Source::kFresh || source == Source::kHeld; }

}  // namespace

FallbackOrder::FallbackOrder(ActionShape shape, const ActionValue& neutral, int hold_steps,
                             Time oldest_held, int ramp_steps, Time now)
    : shape_(std::move(shape)),
      neutral_(neutral),
      hold_steps_(hold_steps),
      oldest_held_(oldest_held),
      ramp_steps_(ramp_steps),
      last_(neutral),
      observed_at_(now),
      ramp_from_(neutral) {
  BeginEpisode();
}

void FallbackOrder::BeginEpisode() {
  last_.Assign(neutral_.view());
  can_hold_ = false;
  ramped_ = ramp_steps_;
}

ChooserView FallbackOrder::chooser() const {
  switch (*source_) {
    case Source::kFresh:
      return fresh_.view();
    case Source::kHeld:
      return {.kind = Chooser::kHeld};
    case Source::kLocal:
      return {.kind = Chooser::kLocal};
    case Source::kSafe:
      break;
  }
  return {.kind = Chooser::kSafe};
}

void FallbackOrder::TakeFresh(const ActionView& action, Time observed_at,
                              const ChooserView& chooser) {
  last_.Assign(action);
  fresh_.Assign(chooser);
  observed_at_ = observed_at;
  held_ = 0;
  can_hold_ = true;
  Enter(Source::kFresh);
}

bool FallbackOrder::Hold(Time now) {
  if (!can_hold_ || held_ >= hold_steps_ || now - observed_at_ > oldest_held_) {
    can_hold_ = false;
    return false;
  }
  ++held_;
  Enter(Source::kHeld);
  return true;
}

void FallbackOrder::TakeLocal(const ActionView& action, Time observed_at) {
  last_.Assign(action);
  observed_at_ = observed_at;
  Enter(Source::kLocal);
}

bool FallbackOrder::Ramp() {
  if (source_ != Source::kSafe) ramp_from_.Assign(last_.view());
  ramped_ = std::min(ramped_, ramp_steps_) + 1;
  if (ramped_ > ramp_steps_ || !shape_.is_box()) return false;
  const float share = static_cast<float>(ramped_) / static_cast<float>(ramp_steps_);
  for (size_t i = 0; i < shape_.size(); ++i) {
    const float from = ramp_from_.continuous[i];
    last_.continuous[i] = from + share * (neutral_.continuous[i] - from);
  }
  Enter(Source::kSafe);
  return true;
}

void FallbackOrder::TakeSafe(const ActionView& action) {
  last_.Assign(action);
  Enter(Source::kSafe);
}

void FallbackOrder::Enter(Source source) {
  if (source != Source::kSafe) ramped_ = 0;
  if (source_ != source) {
    ++entries_[static_cast<size_t>(source)];
    if (source_.has_value() && !(IsServers(*source_) && IsServers(source))) {
      changes_[noted_++ % changes_.size()] = {*source_, source, source_steps_};
    }
    source_ = source;
    source_steps_ = 0;
  }
  ++source_steps_;
}

std::optional<SourceChange> FallbackOrder::TakeChange() {
  if (!has_change()) return std::nullopt;
  if (noted_ - taken_ > changes_.size()) taken_ = noted_ - changes_.size();
  return changes_[taken_++ % changes_.size()];
}

}  // namespace spikeserve::robot
