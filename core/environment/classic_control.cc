#include "core/environment/classic_control.h"

#include <utility>

#include "core/contract/dcheck.h"

namespace spikeserve {

ClassicControl::ClassicControl(Spec spec) : spec_(std::move(spec)), state_(spec_.state_size) {}

std::vector<float> ClassicControl::Reset(uint64_t seed) {
  NumpyRandom random(seed);
  return ResetTo(DrawInitialState(random));
}

std::vector<float> ClassicControl::ResetTo(absl::Span<const double> state) {
  SPIKESERVE_DCHECK_EQ(state.size(), state_.size());
  state_.assign(state.begin(), state.end());
  steps_ = 0;
  running_ = true;
  return Observe(state_);
}

StepResult ClassicControl::Step(const Action& action) {
  SPIKESERVE_DCHECK(
      running_);  // Reset() comes before the first Step(), and after the end of an episode
  const double reward = Advance(action, absl::MakeSpan(state_));
  ++steps_;
  StepResult result = {.observation = Observe(state_),
                       .reward = reward,
                       .terminated = IsTerminal(state_),
                       .truncated = steps_ >= spec_.max_episode_steps};
  running_ = !result.done();
  return result;
}

}  // namespace spikeserve
