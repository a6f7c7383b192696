#include "train/recording/actors.h"

#include <memory>
#include <utility>
#include <vector>

#include "core/math/counter_random.h"
#include "train/recording/policy_player.h"

namespace spikeserve {
namespace {

Action RandomAction(const ActionSpace& space, uint64_t bits) {
  Action action;
  if (space.is_discrete()) {
    action.discrete = static_cast<int>(bits % static_cast<uint64_t>(space.n));
    return action;
  }
  std::vector<float> unit(space.size());
  for (size_t i = 0; i < unit.size(); ++i) {
    unit[i] = 2.0f * UniformFloat(RandomBits({bits, i})) - 1.0f;
  }
  action.continuous = space.FromUnit(unit);
  return action;
}

}  // namespace

Actor ExpertActor(Expert& expert) {
  return [&expert](const View& view) { return Decision{expert.Act(view.state), {}}; };
}

Actor DisturbedActor(Expert& expert, const ActionSpace& space, const Bursts& bursts, Draws draws) {
  const double rate = bursts.rate * UniformDouble(draws(0, 0));
  const auto longest = static_cast<uint64_t>(bursts.longest);
  return [=, &expert, &space, draws = std::move(draws), step = uint64_t{0},
          left = uint64_t{0}](const View& view) mutable {
    ++step;
    Action label = expert.Act(view.state);
    if (left == 0 && UniformDouble(draws(step, 0)) < rate) left = 1 + draws(step, 1) % longest;
    if (left == 0) return Decision{label, label};
    --left;
    return Decision{RandomAction(space, draws(step, 2)), std::move(label)};
  };
}

Actor StudentActor(Expert& expert, const Engine& engine, double target_return) {
  auto player = std::make_shared<PolicyPlayer>(engine, target_return);
  return [&expert, player](const View& view) {
    return Decision{player->Act(view.observation, view.reward), expert.Act(view.state)};
  };
}

Actor RandomActor(const ActionSpace& space, Draws draws) {
  return [&space, draws = std::move(draws), step = uint64_t{0}](const View&) mutable {
    return Decision{RandomAction(space, draws(++step, 0)), {}};
  };
}

}  // namespace spikeserve
