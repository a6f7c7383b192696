#include "core/robot/local_session.h"

namespace spikeserve::robot {

bool LocalSession::Resumed(uint64_t decision, int64_t episode, int64_t step, const StepLog& log) {
  const uint64_t next = log.NumberOf(decision);
  const Episode* const known = log.Find(episode);
  if (known == nullptr || next != known->first + static_cast<uint64_t>(step) ||
      next > known->past() || (step > 0 && !log.Has(next - 1))) {
    state_ = LocalState::kWanted;
    return false;
  }
  episode_ = episode;
  next_ = next;
  state_ = LocalState::kReady;
  return true;
}

void LocalSession::Stop() {
  if (state_ != LocalState::kNone) state_ = LocalState::kWanted;
}

bool LocalSession::Prepare(const StepLog& log) {
  if (!is_ready()) return false;
  const Episode* const episode = log.Find(episode_);
  if (episode == nullptr || (next_ < log.next() && !log.Has(next_)) ||
      (next_ > episode->first && !log.Has(next_ - 1))) {
    Stop();
    return false;
  }
  work_.is_end = next_ == episode->past() && episode->has_ended();
  if (next_ == episode->past() && !work_.is_end) return false;
  work_.number = next_;
  work_.step = static_cast<int64_t>(next_ - episode->first);
  work_.has_executed = work_.step > 0;
  if (work_.has_executed) {
    const StepView before = log.At(next_ - 1);
    work_.executed.Assign(before.executed);
    work_.chooser.Assign(before.chooser);
  }
  if (work_.is_end) {
    work_.outcome = episode->outcome;
    return true;
  }
  const StepView step = log.At(next_);
  work_.observation.assign(step.observation.begin(), step.observation.end());
  work_.reward = step.reward;
  return true;
}

std::optional<uint64_t> LocalSession::Commit() {
  if (work_.is_end) {
    ++episode_;
    return std::nullopt;
  }
  ++next_;
  return work_.observation.empty() ? std::nullopt : std::optional(work_.number);
}

}  // namespace spikeserve::robot
