#include "client/spikectl/distance.h"

#include <utility>

#include "core/action/action_space.h"
#include "core/base/status.h"
#include "core/math/counter_random.h"

namespace spikeserve {

absl::Status Distance::Validate() const {
  if (delay < 0) {
    return InvalidArgument("--delay", "at least 0 steps", delay);
  }
  if (jitter < 0) {
    return InvalidArgument("--jitter", "at least 0 steps", jitter);
  }
  if (!(loss >= 0.0 && loss < 1.0)) {
    return InvalidArgument("--loss", "0 to less than 1", loss);
  }
  return absl::OkStatus();
}

void AddDistanceFlags(FlagGroup& group, Distance* distance) {
  group
      .Add("delay", "STEPS", &distance->delay,
           "Execute each decision so many steps after its observation")
      .Add("jitter", "STEPS", &distance->jitter, "Execute it up to so many steps later")
      .Add("loss", "SHARE", &distance->loss, "Share of the decisions that never arrive");
}

Arrivals::Arrivals(const Distance& distance, const ActionSpace& space, uint64_t seed)
    : distance_(distance), seed_(seed), action_(NeutralAction(space)) {}

const Action& Arrivals::Executed(Action decided) {
  const auto step = static_cast<uint64_t>(step_);
  const auto choices = static_cast<uint64_t>(distance_.jitter) + 1;
  const auto late = static_cast<int64_t>(RandomBits({seed_, step, 0}) % choices);
  if (UniformDouble(RandomBits({seed_, step, 1})) >= distance_.loss) {
    under_way_.push_back({step_ + distance_.delay + late, step_, std::move(decided)});
  }
  for (const Decision& decision : under_way_) {
    if (decision.arrives > step_ || decision.of <= newest_) continue;
    newest_ = decision.of;
    action_ = decision.action;
  }
  std::erase_if(under_way_, [&](const Decision& decision) { return decision.arrives <= step_; });
  ++step_;
  return action_;
}

}  // namespace spikeserve
