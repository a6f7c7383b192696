// An environment whose observations keep some entries and hide the others: without velocities, one
// observation does not tell the state, and an agent has to remember.
//
// What Gymnasium users write with ObservationWrapper, and POPGym (S. Morad et al., ICLR 2023) calls
// PositionOnlyCartPole and PositionOnlyPendulum. State, actions, rewards and endings are those of
// the environment inside.
#ifndef CORE_ENVIRONMENT_POSITION_ONLY_H_
#define CORE_ENVIRONMENT_POSITION_ONLY_H_

#include <memory>
#include <vector>

#include "absl/strings/string_view.h"
#include "core/environment/environment.h"

namespace spikeserve {

class PositionOnly final : public Environment {
 public:
  static constexpr absl::string_view kCartPoleId = "PositionOnlyCartPole-v1";
  static constexpr absl::string_view kPendulumId = "PositionOnlyPendulum-v1";

  // The id of the environment that this one hides entries of; any other id is its own.
  static absl::string_view InsideId(absl::string_view id);

  // CartPole-v1 whose observation [2] is the cart's position and the pole's angle.
  static std::unique_ptr<Environment> MakeCartPole();
  // Pendulum-v1 whose observation [2] is the angle's cosine and sine.
  static std::unique_ptr<Environment> MakePendulum();

  // `kept` are indices of the entries of `inside`'s observation that are shown, in this order.
  PositionOnly(absl::string_view id, std::unique_ptr<Environment> inside, std::vector<int> kept);

  absl::string_view id() const override { return id_; }
  int observation_size() const override { return static_cast<int>(kept_.size()); }
  const ActionSpace& action_space() const override { return inside_->action_space(); }
  int max_episode_steps() const override { return inside_->max_episode_steps(); }
  absl::Span<const double> state() const override { return inside_->state(); }

  std::vector<float> Reset(uint64_t seed) override;
  std::vector<float> ResetTo(absl::Span<const double> state) override;
  StepResult Step(const Action& action) override;

 private:
  std::vector<float> Shown(const std::vector<float>& observation) const;

  const absl::string_view id_;
  const std::unique_ptr<Environment> inside_;
  const std::vector<int> kept_;
};

}  // namespace spikeserve

#endif  // CORE_ENVIRONMENT_POSITION_ONLY_H_
