#include "train/trainer/return_scaling.h"

#include "absl/strings/str_cat.h"
#include "core/environment/position_only.h"

namespace spikeserve {

absl::StatusOr<ReturnScaling> ReturnScalingOf(absl::string_view id) {
  const absl::string_view environment = PositionOnly::InsideId({id.data(), id.size()});
  if (environment == "CartPole-v1") return ReturnScaling{250.0f, 250.0f, 500.0f};
  if (environment == "MountainCar-v0") return ReturnScaling{-100.0f, 100.0f, -95.0f};
  if (environment == "Acrobot-v1") return ReturnScaling{-100.0f, 100.0f, -60.0f};
  if (environment == "Pendulum-v1") return ReturnScaling{-500.0f, 500.0f, -130.0f};
  return absl::NotFoundError(absl::StrCat(
      "env: expected CartPole-v1, MountainCar-v0, Acrobot-v1 or Pendulum-v1, received '", id, "'"));
}

}  // namespace spikeserve
