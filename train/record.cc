#include "train/record.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include "absl/strings/str_cat.h"
#include "core/environment/environment.h"
#include "core/math/counter_random.h"
#include "train/expert.h"

namespace spikeserve {
namespace {

// First part of every key of the counter-based generator, so that no two uses share draws.
enum Stream : uint64_t { kExpertSeeds = 1, kRandomSeeds = 2, kRandomActions = 3 };

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

Episode RecordEpisode(Environment& environment, uint64_t seed, const Controller& controller) {
  Episode episode;
  episode.seed = seed;
  std::vector<float> observation = environment.Reset(seed);
  episode.observations = observation;
  StepResult result;
  while (!result.done()) {
    episode.actions.push_back(controller(observation));
    result = environment.Step(episode.actions.back());
    episode.rewards.push_back(result.reward);
    observation = result.observation;
    episode.observations.insert(episode.observations.end(), observation.begin(), observation.end());
  }
  episode.terminated = result.terminated;
  episode.truncated = result.truncated;
  return episode;
}

// Adds episodes until they hold `steps` steps; returns how many steps they hold.
int RecordSteps(Environment& environment, const std::string& actor, uint64_t seed, uint64_t stream,
                int steps, const Controller& controller, Dataset* dataset) {
  int recorded = 0;
  for (uint64_t i = 0; recorded < steps; ++i) {
    const uint64_t episode_seed = RandomBits({stream, seed, i}) % kFirstEvaluationSeed;
    Episode episode = RecordEpisode(environment, episode_seed, controller);
    episode.actor = actor;
    recorded += episode.steps();
    dataset->episodes.push_back(std::move(episode));
  }
  return recorded;
}

}  // namespace

absl::Status RecordOptions::Validate() const {
  if (steps < 1) {
    return absl::InvalidArgumentError(absl::StrCat("steps: expected at least 1, got ", steps));
  }
  if (!(expert_fraction >= 0.0 && expert_fraction <= 1.0)) {
    return absl::InvalidArgumentError(
        absl::StrCat("expert_fraction: expected 0 to 1, got ", expert_fraction));
  }
  return absl::OkStatus();
}

absl::StatusOr<Dataset> RecordDataset(const RecordOptions& options) {
  if (auto status = options.Validate(); !status.ok()) return status;
  absl::StatusOr<std::unique_ptr<Environment>> environment = MakeEnvironment(options.environment);
  if (!environment.ok()) return environment.status();
  absl::StatusOr<Controller> expert = MakeExpert(options.environment);
  if (!expert.ok()) return expert.status();

  Environment& task = **environment;
  Dataset dataset = {.environment = options.environment,
                     .observation_size = task.observation_size(),
                     .action_space = task.action_space(),
                     .recipe = {},
                     .episodes = {}};
  const int expert_steps = static_cast<int>(std::lround(options.expert_fraction * options.steps));
  uint64_t draw = 0;
  const Controller random = [&](absl::Span<const float>) {
    return RandomAction(task.action_space(), RandomBits({kRandomActions, options.seed, draw++}));
  };
  const int by_expert =
      RecordSteps(task, "expert", options.seed, kExpertSeeds, expert_steps, *expert, &dataset);
  const int by_random = RecordSteps(task, "random", options.seed, kRandomSeeds,
                                    options.steps - expert_steps, random, &dataset);
  dataset.recipe = {{"seed", options.seed},
                    {"expert_steps", by_expert},
                    {"random_steps", by_random},
                    {"episodes", dataset.episodes.size()}};
  return dataset;
}

}  // namespace spikeserve
