// Experts of many skills: each episode is one of a drawn number of steps, and it ends after just so
// many. They show what a return-to-go asks for, where the best expert alone shows one return only.
//
// CartPole-v1: balances the pole as long as it may, then lets it fall. MountainCar-v0: coasts in
// the valley as long as it may, then takes the shortest way out.
#ifndef TRAIN_EXPERT_DIAL_EXPERT_H_
#define TRAIN_EXPERT_DIAL_EXPERT_H_

#include <cstdint>
#include <memory>
#include <optional>

#include "absl/types/span.h"
#include "core/environment/classic_control.h"
#include "train/expert/expert.h"

namespace spikeserve {

// The number of steps an episode is asked to last: uniform from `least` to `most`.
struct EpisodeLengths {
  int least;
  int most;
};

class DialExpert final : public Expert {
 public:
  // `prolong` never ends an episode of `model`, `finish` ends it as soon as it can. A step always
  // pays `reward`.
  DialExpert(std::shared_ptr<const ClassicControl> model, double reward,
             std::unique_ptr<Expert> prolong, std::unique_ptr<Expert> finish,
             EpisodeLengths lengths)
      : model_(std::move(model)),
        reward_(reward),
        prolong_(std::move(prolong)),
        finish_(std::move(finish)),
        lengths_(lengths),
        left_(lengths.most) {}

  // Draws how many steps it will last; what they pay is what is asked for.
  std::optional<double> BeginEpisode(uint64_t key) override;

  // Finishes if that takes all the steps that are left, or more.
  Action Act(absl::Span<const double> state) override;

  // An episode is finished in a few of its steps, which decide how long it was.
  double Stakes(absl::Span<const double> state) override { return MustFinish(state) ? 3.0 : 1.0; }

  std::unique_ptr<Expert> Clone() const override;

 private:
  // Whether `finish` takes `left_` steps or more from `state`.
  bool MustFinish(absl::Span<const double> state);

  std::shared_ptr<const ClassicControl> model_;
  double reward_;
  std::unique_ptr<Expert> prolong_;
  std::unique_ptr<Expert> finish_;
  EpisodeLengths lengths_;
  int left_;  // steps of the episode
};

// Pushes to the side on which the pole falls sooner.
class FallExpert final : public Expert {
 public:
  Action Act(absl::Span<const double> state) override;
  std::unique_ptr<Expert> Clone() const override { return std::make_unique<FallExpert>(); }
};

// Always the same action.
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

#endif  // TRAIN_EXPERT_DIAL_EXPERT_H_
