#include "client/src/pilot/local_copy.h"

#include "absl/strings/str_cat.h"

namespace spikeserve::piloting {

absl::Status LocalCopy::Resumed(const v1::ExportSessionResponse& exported, const BeatLog& log) {
  const uint64_t next = log.NumberOf(exported.decision());
  const RobotEpisode* episode = log.Find(exported.episode());
  const bool is_known = episode != nullptr && next == episode->first + exported.step() &&
                        next <= episode->past() && (exported.step() == 0 || log.Has(next - 1));
  if (!is_known) {
    return absl::FailedPreconditionError(
        absl::StrCat("export: expected one before a kept beat, received one at step ",
                     exported.step(), " of episode ", exported.episode()));
  }
  episode_ = exported.episode();
  next_ = next;
  is_ready_ = true;
  return absl::OkStatus();
}

bool LocalCopy::Prepare(const BeatLog& log) {
  if (!is_ready_) return false;
  const RobotEpisode* episode = log.Find(episode_);
  const bool is_lost = episode == nullptr || (next_ < log.next() && !log.Has(next_)) ||
                       (next_ > episode->first && !log.Has(next_ - 1));
  if (is_lost) {  // the engine was too slow
    is_ready_ = false;
    return false;
  }
  work_.is_end = next_ == episode->past() && episode->ending.has_value();
  if (next_ == episode->past() && !work_.is_end) return false;
  work_.number = next_;
  work_.step = static_cast<int64_t>(next_ - episode->first);
  work_.has_executed = work_.step > 0;
  if (work_.has_executed) work_.executed.Assign(log.At(next_ - 1).executed);
  if (work_.is_end) {
    work_.outcome = episode->ending->outcome;
    return true;
  }
  const BeatView beat = log.At(next_);
  work_.observation.assign(beat.observation.begin(), beat.observation.end());
  work_.reward = beat.reward;
  return true;
}

absl::Status LocalCopy::Play() {
  if (work_.is_end) return policy_->EndEpisode(work_.outcome, work_.executed.view());
  const auto executed = work_.has_executed ? std::optional(work_.executed.view()) : std::nullopt;
  const auto action = policy_->Act(work_.step, work_.observation, work_.reward, executed);
  if (!action.ok()) return action.status();
  action_ = *action;
  return absl::OkStatus();
}

std::optional<uint64_t> LocalCopy::Commit() {
  if (work_.is_end) {
    ++episode_;
    return std::nullopt;
  }
  ++next_;
  return work_.observation.empty() ? std::nullopt : std::optional(work_.number);
}

}  // namespace spikeserve::piloting
