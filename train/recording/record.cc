#include "train/recording/record.h"

#include <algorithm>
#include <cmath>
#include <functional>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "core/environment/classic_tasks.h"
#include "core/environment/environment.h"
#include "core/environment/position_only.h"
#include "core/math/counter_random.h"
#include "train/recording/actors.h"
#include "train/recording/policy_player.h"

namespace spikeserve {
namespace {

// First part of every key of the counter-based generator, so that no two uses share random numbers.
enum Stream : uint64_t {
  kExpertSeeds = 1,
  kRandomSeeds = 2,
  kRandomActions = 3,
  kDisturbedSeeds = 4,
  kBursts = 5,
  kWideStarts = 6,
  kSkills = 7,
  kStudentSeeds = 8
};

// Records an episode that starts from the environment's current state; `observation` is the first
// observation. `weigh` returns the weight of a state's label; null: all weights are 1.
Episode RecordEpisode(Environment& environment, std::vector<float> observation, const Actor& actor,
                      const std::function<double(absl::Span<const double>)>& weigh) {
  Episode episode;
  episode.observations = observation;
  StepResult result;
  result.observation = std::move(observation);
  while (!result.done()) {
    if (weigh) episode.weights.push_back(static_cast<float>(weigh(environment.state())));
    Decision decision = actor({environment.state(), result.observation, result.reward});
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

// One kind of episodes: its actor, its number of steps and its initial states.
struct Source {
  std::string actor;
  Stream seeds;  // the stream that the environment seeds are drawn from
  int steps;
  // `asked` is the return that the expert aims for, from Expert::BeginEpisode().
  std::function<Actor(uint64_t episode, std::optional<double> asked)> make_actor;
  // Changes the initial state that the environment drew for the episode's seed. Null: no change.
  std::function<void(uint64_t episode, std::vector<double>& state)> move_start = nullptr;
};

// With probability wide_start_fraction, replaces Pendulum's velocity by a uniform draw from all
// possible velocities.
void DrawWideStart(const RecordOptions& options, uint64_t episode, std::vector<double>& state) {
  const auto uniform = [&](uint64_t draw) {
    return UniformDouble(RandomBits({kWideStarts, options.seed, episode, draw}));
  };
  if (uniform(0) >= options.wide_start_fraction) return;
  state[1] = kPendulumMaxSpeed * (2.0 * uniform(1) - 1.0);
}

absl::Status CheckFraction(absl::string_view name, double fraction, double most = 1.0) {
  if (fraction >= 0.0 && fraction <= most) return absl::OkStatus();
  return InvalidArgument(name, absl::StrCat("0 to ", most), fraction);
}

// Records all sources of a dataset, one after the other.
class Recorder {
 public:
  Recorder(const RecordOptions& options, std::unique_ptr<Environment> environment,
           std::unique_ptr<Expert> expert)
      : options_(options),
        environment_(std::move(environment)),
        expert_(std::move(expert)),
        engine_(options.student == nullptr ? nullptr : MakeEngine(options.student)) {}

  Dataset Run() {
    Dataset dataset = {.environment = options_.expert.environment,
                       .observation_size = environment_->observation_size(),
                       .action_space = environment_->action_space(),
                       .recipe = {{"seed", options_.seed}},
                       .episodes = {}};
    for (const Source& source : Sources()) {
      if (source.steps == 0) continue;
      dataset.recipe[source.actor + "_steps"] = RecordSteps(source, &dataset);
    }
    dataset.recipe["episodes"] = dataset.episodes.size();
    if (!options_.expert.name.empty()) dataset.recipe["expert"] = options_.expert.name;
    if (options_.weigh) dataset.recipe["weigh"] = true;
    if (options_.disturbed_fraction > 0.0) {
      dataset.recipe["burst_rate"] = options_.burst_rate;
      dataset.recipe["longest_burst"] = options_.longest_burst;
      dataset.recipe["wide_start_fraction"] = options_.wide_start_fraction;
    }
    return dataset;
  }

 private:
  std::vector<Source> Sources() {
    const ActionSpace& space = environment_->action_space();
    const auto share = [&](double fraction) {
      return static_cast<int>(std::lround(fraction * options_.steps));
    };
    const int expert = share(options_.expert_fraction);
    const int disturbed = share(options_.disturbed_fraction);
    const int rest = options_.steps - expert - disturbed;
    const auto draws = [&](Stream stream, uint64_t episode) {
      return [=, seed = options_.seed](uint64_t step, uint64_t draw) {
        return RandomBits({stream, seed, episode, step, draw});
      };
    };
    const Bursts bursts = {options_.burst_rate, options_.longest_burst};
    std::vector<Source> sources = {
        {"expert", kExpertSeeds, expert,
         [&](uint64_t, std::optional<double>) { return ExpertActor(*expert_); }},
        {"disturbed", kDisturbedSeeds, disturbed,
         [=, this, &space](uint64_t episode, std::optional<double>) {
           return DisturbedActor(*expert_, space, bursts, draws(kBursts, episode));
         },
         [&](uint64_t episode, std::vector<double>& state) {
           DrawWideStart(options_, episode, state);
         }}};
    if (engine_ != nullptr) {
      sources.push_back(
          {"student", kStudentSeeds, rest, [&](uint64_t /*episode*/, std::optional<double> asked) {
             return StudentActor(
                 *expert_, *engine_,
                 asked.value_or(static_cast<double>(engine_->policy().target_return)));
           }});
    } else {
      // All random episodes share one sequence of random numbers.
      sources.push_back(
          {"random", kRandomSeeds, rest, [this, &space](uint64_t, std::optional<double>) {
             return RandomActor(space, [this](uint64_t, uint64_t) {
               return RandomBits({kRandomActions, options_.seed, random_draws_++});
             });
           }});
    }
    return sources;
  }

  // Adds episodes to `dataset` until they have at least source.steps steps, and returns their
  // number of steps.
  int RecordSteps(const Source& source, Dataset* dataset) {
    std::function<double(absl::Span<const double>)> weigh;
    if (options_.weigh) {
      weigh = [&](absl::Span<const double> state) {
        return std::clamp(expert_->StateImportance(state), kLeastWeight, kMostWeight);
      };
    }
    int recorded = 0;
    for (uint64_t i = 0; recorded < source.steps; ++i) {
      const uint64_t seed = RandomBits({source.seeds, options_.seed, i}) % kFirstEvaluationSeed;
      std::vector<float> observation = environment_->Reset(seed);
      if (source.move_start) {
        std::vector<double> state(environment_->state().begin(), environment_->state().end());
        source.move_start(i, state);
        observation = environment_->ResetTo(state);
      }
      const std::optional<double> asked =
          expert_->BeginEpisode(RandomBits({kSkills, source.seeds, options_.seed, i}));
      Episode episode =
          RecordEpisode(*environment_, std::move(observation), source.make_actor(i, asked), weigh);
      if (source.actor != "random") episode.target_return = asked;
      episode.actor = source.actor;
      episode.seed = seed;
      recorded += episode.steps();
      dataset->episodes.push_back(std::move(episode));
    }
    return recorded;
  }

  const RecordOptions& options_;
  const std::unique_ptr<Environment> environment_;
  const std::unique_ptr<Expert> expert_;
  const std::unique_ptr<Engine> engine_;  // the student's engine; null without a student
  uint64_t random_draws_ = 0;
};

}  // namespace

absl::Status RecordOptions::Validate() const {
  if (steps < 1) {
    return InvalidArgument("steps", "at least 1", steps);
  }
  absl::Status status = CheckFraction("expert_fraction", expert_fraction);
  // The tolerance allows for rounding: the sum of fractions such as 0.9 and 0.1 may exceed 1
  // slightly.
  status.Update(CheckFraction("disturbed_fraction", disturbed_fraction,
                              std::max(0.0, 1.0 - expert_fraction + 1e-9)));
  status.Update(CheckFraction("burst_rate", burst_rate));
  status.Update(CheckFraction("wide_start_fraction", wide_start_fraction));
  if (!status.ok()) return status;
  if (longest_burst < 1) {
    return InvalidArgument("longest_burst", "at least 1", longest_burst);
  }
  if (wide_start_fraction > 0.0 && PositionOnly::InsideId(expert.environment) != kPendulumId) {
    return InvalidArgument("wide_start_fraction", absl::StrCat("0 for ", expert.environment),
                           wide_start_fraction);
  }
  return absl::OkStatus();
}

std::string RecordOptions::ToFlags() const {
  std::string flags = absl::StrFormat(
      "--env=%s --steps=%d --expert_fraction=%g --disturbed_fraction=%g --burst_rate=%g "
      "--longest_burst=%d --wide_start_fraction=%g",
      expert.environment, steps, expert_fraction, disturbed_fraction, burst_rate, longest_burst,
      wide_start_fraction);
  if (!expert.name.empty()) absl::StrAppend(&flags, " --expert=", expert.name);
  if (weigh) absl::StrAppend(&flags, " --weigh");
  return flags;
}

absl::StatusOr<Dataset> RecordDataset(const RecordOptions& options) {
  RETURN_IF_ERROR(options.Validate());
  ASSIGN_OR_RETURN(std::unique_ptr<Environment> environment,
                   MakeEnvironment(options.expert.environment));
  if (options.student != nullptr) {
    if (auto status = CheckSpacesMatch(*options.student, *environment); !status.ok()) return status;
  }
  ASSIGN_OR_RETURN(std::unique_ptr<Expert> expert, MakeExpert(options.expert));
  return Recorder(options, std::move(environment), std::move(expert)).Run();
}

}  // namespace spikeserve
