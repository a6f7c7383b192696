#include "core/environment/environment.h"

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/environment/classic_tasks.h"
#include "core/environment/position_only.h"

namespace spikeserve {
namespace {

template <auto MakeTask>
std::unique_ptr<Environment> Make() {
  return MakeTask({});
}

struct Entry {
  absl::string_view id;
  std::unique_ptr<Environment> (*make)();
};

constexpr Entry kEnvironments[] = {
    {kCartPoleId, Make<MakeCartPole>},
    {kMountainCarId, Make<MakeMountainCar>},
    {kAcrobotId, Make<MakeAcrobot>},
    {kPendulumId, Make<MakePendulum>},
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
