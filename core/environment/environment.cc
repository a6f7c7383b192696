#include "core/environment/environment.h"

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/environment/acrobot.h"
#include "core/environment/cart_pole.h"
#include "core/environment/mountain_car.h"
#include "core/environment/pendulum.h"
#include "core/environment/position_only.h"

namespace spikeserve {
namespace {

template <typename Task>
std::unique_ptr<Environment> Make() {
  return std::make_unique<Task>();
}

struct Entry {
  absl::string_view id;
  std::unique_ptr<Environment> (*make)();
};

constexpr Entry kEnvironments[] = {
    {CartPole::kId, Make<CartPole>},
    {MountainCar::kId, Make<MountainCar>},
    {Acrobot::kId, Make<Acrobot>},
    {Pendulum::kId, Make<Pendulum>},
    {PositionOnly::kCartPoleId, PositionOnly::MakeCartPole},
    {PositionOnly::kPendulumId, PositionOnly::MakePendulum},
};

}  // namespace

absl::StatusOr<std::unique_ptr<Environment>> MakeEnvironment(absl::string_view id) {
  std::vector<std::string> ids;
  for (const Entry& entry : kEnvironments) {
    if (entry.id == id) return entry.make();
    ids.emplace_back(entry.id);
  }
  return absl::NotFoundError(absl::StrCat("environment: expected one of ", absl::StrJoin(ids, ", "),
                                          ", received \"", std::string(id), "\""));
}

}  // namespace spikeserve
