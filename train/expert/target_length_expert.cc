#include "train/expert/target_length_expert.h"

#include <vector>

#include "core/environment/classic_tasks.h"
#include "core/math/counter_random.h"

namespace spikeserve {

std::optional<double> TargetLengthExpert::BeginEpisode(uint64_t key) {
  const auto choices = static_cast<uint64_t>(lengths_.most - lengths_.least + 1);
  left_ = lengths_.least + static_cast<int>(RandomBits({key}) % choices);
  return reward_ * left_;
}

Action TargetLengthExpert::Act(absl::Span<const double> state) {
  Action action = MustFinish(state) ? finish_->Act(state) : prolong_->Act(state);
  --left_;
  return action;
}

std::unique_ptr<Expert> TargetLengthExpert::Clone() const {
  auto clone = std::make_unique<TargetLengthExpert>(model_, reward_, prolong_->Clone(),
                                                    finish_->Clone(), lengths_);
  clone->left_ = left_;
  return clone;
}

bool TargetLengthExpert::MustFinish(absl::Span<const double> state) {
  std::vector<double> ahead(state.begin(), state.end());
  for (int step = 1; step < left_; ++step) {
    model_->Advance(finish_->Act(ahead), absl::MakeSpan(ahead));
    if (model_->IsTerminal(ahead)) return false;
  }
  return true;
}

Action FallExpert::Act(absl::Span<const double> state) {
  const auto model = MakeCartPole();
  std::vector<double> pushed[2];
  for (auto& side : pushed) side.assign(state.begin(), state.end());
  while (true) {
    for (int push = 0; push < 2; ++push) {
      const Action action = {.discrete = push, .continuous = {}};
      model->Advance(action, absl::MakeSpan(pushed[push]));
      if (model->IsTerminal(pushed[push])) return action;
    }
  }
}

}  // namespace spikeserve
