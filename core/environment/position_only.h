// Wraps an environment and hides some entries of its observation. Without velocities, one
// observation does not determine the state, so an agent needs memory.
//
// Equivalent to a Gymnasium ObservationWrapper. POPGym (S. Morad et al., ICLR 2023) calls these
// tasks PositionOnlyCartPole and PositionOnlyPendulum. State, actions, rewards and ends of episodes
// are those of the wrapped environment.
#pragma once

#include <memory>
#include <vector>

#include "absl/strings/string_view.h"
#include "core/environment/environment.h"

namespace spikeserve {

// An environment with a shortened observation. Not thread-safe.
class PositionOnly final : public Environment {
 public:
  static constexpr absl::string_view kCartPoleId = "PositionOnlyCartPole-v1";
  static constexpr absl::string_view kPendulumId = "PositionOnlyPendulum-v1";

  // Returns the id of the environment that `id` wraps, or `id` itself if it wraps none.
  static absl::string_view InsideId(absl::string_view id);

  // Makes CartPole-v1 with the observation [2]: cart position, pole angle.
  static std::unique_ptr<Environment> MakeCartPole();
  // Makes Pendulum-v1 with the observation [2]: cosine and sine of the angle.
  static std::unique_ptr<Environment> MakePendulum();
  // Wraps `inside`, a CartPole-v1 or Pendulum-v1, as these do. REQUIRES: `id` is one of the above.
  static std::unique_ptr<Environment> Wrap(absl::string_view id,
                                           std::unique_ptr<Environment> inside);

  // Wraps `inside`. `kept` lists the indices of the visible entries of its observation, in the
  // order of the new observation.
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
  // Returns the kept entries of `observation`.
  std::vector<float> KeepEntries(const std::vector<float>& observation) const;

  const absl::string_view id_;
  const std::unique_ptr<Environment> inside_;
  const std::vector<int> kept_;
};

}  // namespace spikeserve
