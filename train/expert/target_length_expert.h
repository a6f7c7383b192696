// Experts that end every episode after a random, known number of steps. Their data cover many
// returns, so that a policy learns to follow the return-to-go; the best expert alone would show a
// single return.
//
// CartPole-v1: balances the pole for most of the episode, then lets it fall. MountainCar-v0: coasts
// in the valley for most of the episode, then takes the shortest way out.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>

#include "absl/types/span.h"
#include "core/environment/classic_control.h"
#include "train/expert/expert.h"

namespace spikeserve {

// The range of episode lengths, in steps. Each episode draws its length uniformly from [least,
// most].
struct EpisodeLengths {
  int least;
  int most;
};

class TargetLengthExpert final : public Expert {
 public:
  // Acts by `prolong`, which never ends an episode of `model`, and at the end by `finish`, which
  // ends it as soon as possible. Every step pays `reward`.
  TargetLengthExpert(std::shared_ptr<const ClassicControl> model, double reward,
                     std::unique_ptr<Expert> prolong, std::unique_ptr<Expert> finish,
                     EpisodeLengths lengths)
      : model_(std::move(model)),
        reward_(reward),
        prolong_(std::move(prolong)),
        finish_(std::move(finish)),
        lengths_(lengths),
        left_(lengths.most) {}

  // Draws the number of steps of the episode and returns the return that they pay.
  std::optional<double> BeginEpisode(uint64_t key) override;

  // Switches to `finish` once finishing takes all remaining steps or more.
  Action Act(absl::Span<const double> state) override;

  // Returns 3 for the few steps in which the episode is being finished, because they decide its
  // length, and 1 for all others.
  double StateImportance(absl::Span<const double> state) override {
    return MustFinish(state) ? 3.0 : 1.0;
  }

  std::unique_ptr<Expert> Clone() const override;

 private:
  // Returns whether `finish` takes `left_` steps or more from `state`.
  bool MustFinish(absl::Span<const double> state);

  std::shared_ptr<const ClassicControl> model_;
  double reward_;
  std::unique_ptr<Expert> prolong_;
  std::unique_ptr<Expert> finish_;
  EpisodeLengths lengths_;
  int left_;  // remaining steps of the episode
};

// Pushes CartPole's cart to the side that ends the episode sooner.
class FallExpert final : public Expert {
 public:
  Action Act(absl::Span<const double> state) override;
  std::unique_ptr<Expert> Clone() const override { return std::make_unique<FallExpert>(); }
};

// Always returns the same action.
class ConstantExpert final : public Expert {
 public:
  explicit ConstantExpert(Action action) : action_(std::move(action)) {}
  Action Act(absl::Span<const double>) override { return action_; }
  std::unique_ptr<Expert> Clone() const override {
    return std::make_unique<ConstantExpert>(action_);
  }

 private:
  Action action_;
};

}  // namespace spikeserve
