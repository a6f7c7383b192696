#include "train/expert/expert.h"

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/environment/position_only.h"
#include "train/expert/experts.h"

namespace spikeserve {

absl::Status ExpertOptions::Validate() const {
  if (beam_width < 1) {
    return InvalidArgument("beam_width", "at least 1", beam_width);
  }
  if (coarsening != 1 && coarsening != 2 && coarsening != 4 && coarsening != 8) {
    return InvalidArgument("coarsening", "1, 2, 4 or 8", coarsening);
  }
  return absl::OkStatus();
}

absl::Status UnknownExpert(const ExpertOptions& options, absl::string_view expected) {
  return absl::NotFoundError(absl::StrCat("expert: expected ", expected, " for ",
                                          options.environment, ", received '", options.name, "'"));
}

absl::StatusOr<std::unique_ptr<Expert>> MakeExpert(const ExpertOptions& options) {
  RETURN_IF_ERROR(options.Validate());
  // Experts act on the full state, so an environment that hides velocities has the same experts.
  const absl::string_view environment = PositionOnly::InsideId(options.environment);
  if (environment == "CartPole-v1") return MakeCartPoleExpert(options);
  if (environment == "MountainCar-v0") return MakeMountainCarExpert(options);
  if (environment == "Pendulum-v1") return MakePendulumExpert(options);
  if (environment == "Acrobot-v1") return MakeAcrobotExpert(options);
  return absl::NotFoundError(
      absl::StrCat("env: there are experts for CartPole-v1, MountainCar-v0, Pendulum-v1 and "
                   "Acrobot-v1, none for '",
                   options.environment, "'"));
}

}  // namespace spikeserve
