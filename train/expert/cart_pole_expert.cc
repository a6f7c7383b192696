// Experts for CartPole. The feedback expert pushes right if 0.1 x + 0.3 x' + 3 theta + theta' > 0,
// a linear feedback on position, velocity, angle and angular velocity. It balances the pole for all
// 500 steps from every initial state that Gymnasium draws.
#include <memory>

#include "core/environment/classic_tasks.h"
#include "train/expert/experts.h"
#include "train/expert/target_length_expert.h"

namespace spikeserve {
namespace {

class FeedbackExpert final : public Expert {
 public:
  Action Act(absl::Span<const double> state) override {
    // Computes in float32, the precision of the observation that an agent receives.
    const auto s = [&](int i) { return static_cast<float>(state[i]); };
    return {.discrete = 0.1f * s(0) + 0.3f * s(1) + 3.0f * s(2) + s(3) > 0.0f ? 1 : 0,
            .continuous = {}};
  }

  std::unique_ptr<Expert> Clone() const override { return std::make_unique<FeedbackExpert>(); }
};

}  // namespace

absl::StatusOr<std::unique_ptr<Expert>> MakeCartPoleExpert(const ExpertOptions& options) {
  if (options.name.empty() || options.name == "feedback") return std::make_unique<FeedbackExpert>();
  if (options.name != "return_conditioned") {
    return UnknownExpert(options, "feedback or return_conditioned");
  }
  return std::make_unique<TargetLengthExpert>(
      MakeCartPole(), /*reward=*/1.0, std::make_unique<FeedbackExpert>(),
      std::make_unique<FallExpert>(), EpisodeLengths{.least = 10, .most = 500});
}

}  // namespace spikeserve
