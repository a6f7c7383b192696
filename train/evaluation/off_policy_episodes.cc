#include "train/evaluation/off_policy_episodes.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/action/action_head.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "train/evaluation/neurobench.h"

namespace spikeserve {
namespace {

using Eigen::Index;

constexpr double kLeastProbability = 1e-30;  // of a softmax in float32 that is 0

absl::Status Refuse(absl::string_view expected, absl::string_view received) {
  return InvalidArgument("episode", expected, received);
}

absl::Status CheckRecorded(const Policy& policy, const Dataset& dataset,
                           const ServedEpisode& first) {
  for (const Episode& episode : dataset.episodes) {
    RETURN_IF_ERROR(CheckServedEpisode(policy, dataset, episode));
    const ServedEpisode& served = *episode.served;
    if (!served.temperature.has_value()) {
      return Refuse("actions that were drawn at random",
                    "greedy ones, which never show what another action earns; open sessions with "
                    "action_selection SAMPLE");
    }
    if (served.learning) return Refuse("a session with the policy's head", "one that learned");
    if (!dataset.action_space.is_discrete() && served.noise.empty()) {
      return Refuse("the noise of the actions", "a recording of an earlier server, without it");
    }
    if (served.policy != first.policy || served.version != first.version ||
        served.policy_sha256 != first.policy_sha256) {
      return Refuse(absl::StrCat("one of ", first.policy, "/", first.version, ", as the first"),
                    absl::StrCat("one of ", served.policy, "/", served.version,
                                 served.version == first.version ? " with another file" : ""));
    }
  }
  return absl::OkStatus();
}

double LogNormal(double x, double mean, double deviation) {
  const double z = (x - mean) / deviation;
  return -0.5 * z * z - std::log(deviation);
}

// Writes 1 and the means of tanh(z + deviation * noise) and of its square over the noise, which is
// standard normal, for each element of `logits`. The trapezoidal rule is exact to rounding here.
template <typename Row>
void DescribeBox(absl::Span<const float> logits, double deviation, Row description) {
  constexpr double kStep = 0.25, kEnd = 6.0;
  description.setZero();
  description[0] = 1.0;
  for (size_t i = 0; i < logits.size(); ++i) {
    for (double noise = -kEnd; noise <= kEnd; noise += kStep) {
      const double weight = kStep * std::exp(-0.5 * noise * noise) / std::sqrt(2.0 * M_PI);
      const double action = std::tanh(static_cast<double>(logits[i]) + deviation * noise);
      description[static_cast<Index>(1 + 2 * i)] += weight * action;
      description[static_cast<Index>(2 + 2 * i)] += weight * action * action;
    }
  }
}

// Returns whether the policy's answer decided what happened at `step`: it was executed, or a filter
// of the robot made an action of it. The neutral action of a server that refuses a wiring is the
// answer itself.
bool IsPolicys(const Episode& episode, int step) {
  const SourceKind kind = episode.source(step).kind;
  if (kind == SourceKind::kPolicy || kind == SourceKind::kUnknown) return true;
  return kind == SourceKind::kSafetyLayer && episode.actions[step] != episode.answered(step);
}

// Lets `engine` decide one episode again.
class Replay {
 public:
  Replay(const Engine& engine, const Dataset& dataset, const Episode& episode,
         const OffPolicyConditions& conditions)
      : dataset_(dataset),
        episode_(episode),
        served_(*episode.served),
        recorded_(static_cast<double>(*served_.temperature)),
        evaluated_(conditions.temperature.value_or(recorded_)),
        shift_(conditions.target_return.value_or(served_.target_return) - served_.target_return),
        engine_(engine) {}

  OffPolicyEpisode Run() {
    const Policy& policy = engine_.policy();
    const size_t steps = episode_.actions.size(), actions = policy.action_space.size();
    const auto size = static_cast<size_t>(dataset_.observation_size);
    const auto width =
        static_cast<Index>(policy.action_space.is_discrete() ? actions : 1 + 2 * actions);
    const auto rows = static_cast<Index>(steps);
    result_.rewards = episode_.rewards;
    result_.log_ratios.resize(steps);
    result_.state.resize(rows, static_cast<Index>(size) + 2);
    for (auto* matrix : {&result_.taken, &result_.recorded, &result_.evaluated}) {
      matrix->setZero(rows, width);
    }
    const auto context = engine_.NewContext();
    Engine::Output output;
    ActionChoice choice;
    std::vector<float> encoded(actions);
    const ActionSelection selection = {.sample = true,
                                       .temperature = static_cast<float>(evaluated_)};
    for (size_t t = 0; t < steps; ++t) {
      const auto observation = absl::MakeConstSpan(episode_.observations).subspan(t * size, size);
      const double return_to_go = static_cast<double>(served_.returns_to_go[t]) + shift_;
      engine_.Decide(*context, static_cast<float>(return_to_go), observation, &output);
      ChooseAction(policy.weights.head, policy.action_space, output.readout, selection,
                   /*random=*/0, &choice);
      auto state = result_.state.row(static_cast<Index>(t));
      for (size_t i = 0; i < size; ++i) {
        state[static_cast<Index>(i)] = static_cast<double>(observation[i]);
      }
      state[static_cast<Index>(size)] = static_cast<double>(t);
      state[static_cast<Index>(size) + 1] = return_to_go;
      policy.action_space.Encode(episode_.actions[t], absl::MakeSpan(encoded));
      if (!IsPolicys(episode_, static_cast<int>(t))) {
        TakeOthers(t, encoded);
      } else {
        policy.action_space.is_discrete() ? CompareDiscrete(t, choice) : CompareBox(t, choice);
      }
      engine_.AppendAction(*context, encoded);
    }
    return std::move(result_);
  }

 private:
  void CompareDiscrete(size_t t, const ActionChoice& choice) {
    const size_t n = choice.probabilities.size();
    const auto row = static_cast<Index>(t);
    for (size_t i = 0; i < n; ++i) {
      result_.recorded(row, static_cast<Index>(i)) = served_.probabilities[t * n + i];
      result_.evaluated(row, static_cast<Index>(i)) = choice.probabilities[i];
    }
    const Index taken = episode_.answered(static_cast<int>(t)).discrete;
    result_.taken(row, taken) = 1.0;
    result_.log_ratios[t] = std::log(std::max(result_.evaluated(row, taken), kLeastProbability)) -
                            std::log(std::max(result_.recorded(row, taken), kLeastProbability));
  }

  void CompareBox(size_t t, const ActionChoice& choice) {
    const size_t n = choice.logits.size();
    const auto logits = absl::MakeConstSpan(served_.logits).subspan(t * n, n);
    const auto row = static_cast<Index>(t);
    DescribeBox(logits, recorded_, result_.recorded.row(row));
    DescribeBox(choice.logits, evaluated_, result_.evaluated.row(row));
    result_.taken(row, 0) = 1.0;
    for (size_t i = 0; i < n; ++i) {
      // The sample before tanh: its density has the same ratio as that of the action.
      const auto mean = static_cast<double>(logits[i]);
      const double sample = mean + recorded_ * static_cast<double>(served_.noise[t * n + i]);
      const double action = std::tanh(sample);
      result_.taken(row, static_cast<Index>(1 + 2 * i)) = action;
      result_.taken(row, static_cast<Index>(2 + 2 * i)) = action * action;
      result_.log_ratios[t] +=
          LogNormal(sample, static_cast<double>(choice.logits[i]), evaluated_) -
          LogNormal(sample, mean, recorded_);
    }
  }

  // Both policies meet the executed action, whatever they would have done.
  void TakeOthers(size_t t, absl::Span<const float> encoded) {
    const bool is_discrete = dataset_.action_space.is_discrete();
    auto taken = result_.taken.row(static_cast<Index>(t));
    if (!is_discrete) taken[0] = 1.0;
    for (size_t i = 0; i < encoded.size(); ++i) {
      const auto action = static_cast<double>(encoded[i]);
      taken[static_cast<Index>(is_discrete ? i : 1 + 2 * i)] = action;
      if (!is_discrete) taken[static_cast<Index>(2 + 2 * i)] = action * action;
    }
    result_.recorded.row(static_cast<Index>(t)) = taken;
    result_.evaluated.row(static_cast<Index>(t)) = taken;
  }

  const Dataset& dataset_;
  const Episode& episode_;
  const ServedEpisode& served_;
  const double recorded_;  // temperatures
  const double evaluated_;
  const double shift_;  // of the returns-to-go
  const Engine& engine_;
  OffPolicyEpisode result_;
};

// Numbers the units of the episodes; see RecordedDecisions.
void NumberUnits(const std::vector<uint64_t>& seeds, const std::vector<bool>& starts,
                 std::vector<OffPolicyEpisode>* episodes) {
  std::map<uint64_t, size_t> units;
  size_t sessions = 0;
  for (size_t i = 0; i < seeds.size(); ++i) {
    sessions += starts[i] ? 1 : 0;
    (*episodes)[i].unit = units.emplace(seeds[i], units.size()).first->second;
  }
  if (units.size() >= kFewestUnits || units.size() < sessions) return;
  for (size_t i = 0; i < episodes->size(); ++i) (*episodes)[i].unit = i;
}

}  // namespace

absl::StatusOr<RecordedDecisions> DecideRecorded(const std::vector<Dataset>& recordings,
                                                 std::shared_ptr<const Policy> policy,
                                                 const OffPolicyConditions& conditions) {
  const std::unique_ptr<Engine> engine = MakeEngine(std::move(policy));
  RecordedDecisions decisions;
  std::vector<uint64_t> seeds;
  std::vector<bool> starts;  // of a session
  const ServedEpisode* first = nullptr;
  const ServedEpisode* before = nullptr;
  for (const Dataset& dataset : recordings) {
    if (first == nullptr && dataset.episodes[0].served.has_value()) {
      first = &*dataset.episodes[0].served;
    }
    RETURN_IF_ERROR(
        CheckRecorded(engine->policy(), dataset, first == nullptr ? ServedEpisode() : *first));
    for (const Episode& episode : dataset.episodes) {
      const ServedEpisode& served = *episode.served;
      starts.push_back(before == nullptr || served.episode <= before->episode ||
                       served.seed != before->seed);
      seeds.push_back(served.seed);
      before = &served;
      for (int t = 0; t < episode.steps(); ++t) {
        ++decisions.steps[static_cast<size_t>(episode.source(t).kind)];
      }
      decisions.episodes.push_back(Replay(*engine, dataset, episode, conditions).Run());
    }
  }
  if (decisions.episodes.size() < 2) return Refuse("at least two", "one");
  decisions.policy = first->policy;
  decisions.version = first->version;
  decisions.sha256 = first->policy_sha256;
  NumberUnits(seeds, starts, &decisions.episodes);
  return decisions;
}

}  // namespace spikeserve
