#include "train/record.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <memory>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/types/optional.h"
#include "core/environment/environment.h"
#include "core/environment/pendulum.h"
#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

// First part of every key of the counter-based generator, so that no two uses share draws.
enum Stream : uint64_t {
  kExpertSeeds = 1,
  kRandomSeeds = 2,
  kRandomActions = 3,
  kDisturbedSeeds = 4,
  kBursts = 5,
  kWideStarts = 6
};

// What is done in a state, and what would have been right.
struct Decision {
  Action action;
  absl::optional<Action> label;  // nothing where that is the action
};
using Actor = std::function<Decision(absl::Span<const double> state)>;

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

// From where `environment` was reset to.
Episode RecordEpisode(Environment& environment, std::vector<float> observation,
                      const Actor& actor) {
  Episode episode;
  episode.observations = std::move(observation);
  StepResult result;
  while (!result.done()) {
    Decision decision = actor(environment.state());
    result = environment.Step(decision.action);
    episode.actions.push_back(std::move(decision.action));
    if (decision.label) episode.labels.push_back(*std::move(decision.label));
    episode.rewards.push_back(result.reward);
    episode.observations.insert(episode.observations.end(), result.observation.begin(),
                                result.observation.end());
  }
  episode.terminated = result.terminated;
  episode.truncated = result.truncated;
  return episode;
}

// Episodes of one kind: who acts in them and how they start.
struct Source {
  std::string actor;
  uint64_t seeds;  // the stream of their seeds
  int steps;
  std::function<Actor(uint64_t episode)> make_actor;
  // From the initial state of the episode's seed to the one it starts from.
  std::function<void(uint64_t episode, std::vector<double>& state)> move_start = nullptr;
};

// Adds episodes until they hold the source's steps; returns how many they hold.
int RecordSteps(Environment& environment, const Source& source, uint64_t seed, Dataset* dataset) {
  int recorded = 0;
  for (uint64_t i = 0; recorded < source.steps; ++i) {
    const uint64_t episode_seed = RandomBits({source.seeds, seed, i}) % kFirstEvaluationSeed;
    std::vector<float> observation = environment.Reset(episode_seed);
    if (source.move_start) {
      std::vector<double> state(environment.state().begin(), environment.state().end());
      source.move_start(i, state);
      observation = environment.ResetTo(state);
    }
    Episode episode = RecordEpisode(environment, std::move(observation), source.make_actor(i));
    episode.actor = source.actor;
    episode.seed = episode_seed;
    recorded += episode.steps();
    dataset->episodes.push_back(std::move(episode));
  }
  return recorded;
}

// The expert, but for bursts of random actions.
Actor Disturbed(Expert& expert, const ActionSpace& space, const RecordOptions& options,
                uint64_t episode) {
  const auto bits = [seed = options.seed, episode](uint64_t step, uint64_t draw) {
    return RandomBits({kBursts, seed, episode, step, draw});
  };
  const double rate = options.burst_rate * UniformDouble(bits(0, 0));
  const auto longest = static_cast<uint64_t>(options.longest_burst);
  return [=, &expert, &space, step = uint64_t{0},
          left = uint64_t{0}](absl::Span<const double> state) mutable {
    ++step;
    Action label = expert.Act(state);
    if (left == 0 && UniformDouble(bits(step, 0)) < rate) left = 1 + bits(step, 1) % longest;
    if (left == 0) return Decision{label, label};
    --left;
    return Decision{RandomAction(space, bits(step, 2)), std::move(label)};
  };
}

// With the options' probability, replaces Pendulum's velocity by any it can have.
void WidenStart(const RecordOptions& options, uint64_t episode, std::vector<double>& state) {
  const auto uniform = [&](uint64_t draw) {
    return UniformDouble(RandomBits({kWideStarts, options.seed, episode, draw}));
  };
  if (uniform(0) >= options.wide_start_fraction) return;
  state[1] = Pendulum::kMaxSpeed * (2.0 * uniform(1) - 1.0);
}

absl::Status CheckFraction(absl::string_view name, double fraction, double most = 1.0) {
  if (fraction >= 0.0 && fraction <= most) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat(name, ": expected 0 to ", most, ", got ", fraction));
}

}  // namespace

absl::Status RecordOptions::Validate() const {
  if (steps < 1) {
    return absl::InvalidArgumentError(absl::StrCat("steps: expected at least 1, got ", steps));
  }
  absl::Status status = CheckFraction("expert_fraction", expert_fraction);
  // The sum of shares such as 0.9 and 0.1 may round to a little more than 1.
  status.Update(CheckFraction("disturbed_fraction", disturbed_fraction,
                              std::max(0.0, 1.0 - expert_fraction + 1e-9)));
  status.Update(CheckFraction("burst_rate", burst_rate));
  status.Update(CheckFraction("wide_start_fraction", wide_start_fraction));
  if (!status.ok()) return status;
  if (longest_burst < 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("longest_burst: expected at least 1, got ", longest_burst));
  }
  if (wide_start_fraction > 0.0 && expert.environment != Pendulum::kId) {
    return absl::InvalidArgumentError(absl::StrCat(
        "wide_start_fraction: expected 0 for ", expert.environment, ", got ", wide_start_fraction));
  }
  return absl::OkStatus();
}

absl::StatusOr<Dataset> RecordDataset(const RecordOptions& options) {
  if (auto status = options.Validate(); !status.ok()) return status;
  absl::StatusOr<std::unique_ptr<Environment>> environment =
      MakeEnvironment(options.expert.environment);
  if (!environment.ok()) return environment.status();
  absl::StatusOr<std::unique_ptr<Expert>> expert = MakeExpert(options.expert);
  if (!expert.ok()) return expert.status();

  Environment& task = **environment;
  const ActionSpace& space = task.action_space();
  const auto share = [&](double fraction) {
    return static_cast<int>(std::lround(fraction * options.steps));
  };
  const int expert_steps = share(options.expert_fraction);
  const int disturbed_steps = share(options.disturbed_fraction);
  const Actor by_expert = [&](absl::Span<const double> state) {
    return Decision{(*expert)->Act(state), {}};
  };
  uint64_t draw = 0;
  const Actor by_chance = [&](absl::Span<const double>) {
    return Decision{RandomAction(space, RandomBits({kRandomActions, options.seed, draw++})), {}};
  };
  const Source sources[] = {
      {"expert", kExpertSeeds, expert_steps, [&](uint64_t) { return by_expert; }},
      {"disturbed", kDisturbedSeeds, disturbed_steps,
       [&](uint64_t episode) { return Disturbed(**expert, space, options, episode); },
       [&](uint64_t episode, std::vector<double>& state) { WidenStart(options, episode, state); }},
      {"random", kRandomSeeds, options.steps - expert_steps - disturbed_steps,
       [&](uint64_t) { return by_chance; }}};

  Dataset dataset = {.environment = options.expert.environment,
                     .observation_size = task.observation_size(),
                     .action_space = space,
                     .recipe = {{"seed", options.seed}},
                     .episodes = {}};
  for (const Source& source : sources) {
    const int steps = RecordSteps(task, source, options.seed, &dataset);
    if (source.actor == "disturbed" && steps == 0) continue;
    dataset.recipe[source.actor + "_steps"] = steps;
  }
  dataset.recipe["episodes"] = dataset.episodes.size();
  if (!options.expert.name.empty()) dataset.recipe["expert"] = options.expert.name;
  if (disturbed_steps > 0) {
    dataset.recipe["burst_rate"] = options.burst_rate;
    dataset.recipe["longest_burst"] = options.longest_burst;
    dataset.recipe["wide_start_fraction"] = options.wide_start_fraction;
  }
  return dataset;
}

}  // namespace spikeserve
