#include "core/agent/episode_recorder.h"

#include <algorithm>
#include <limits>
#include <utility>
#include <vector>

#include "absl/types/span.h"
#include "core/model/features.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

// Adds the names of a policy's elements to a recipe, for policies that are trained on it.
void AddNames(const char* key, const std::vector<Feature>& features, nlohmann::json* recipe) {
  for (const Feature& feature : features) (*recipe)[key].push_back(feature.name);
}

}  // namespace

EpisodeRecorder::EpisodeRecorder(std::shared_ptr<const ServedPolicy> served, Sink sink)
    : served_(std::move(served)), sink_(std::move(sink)) {}

EpisodeRecorder::~EpisodeRecorder() { CutOff(); }

void EpisodeRecorder::OnDecision(const Session& session, const DecisionInputs& inputs) {
  const Answer& answer = *session.last_answer;
  if (answer.step == 0) {
    Start(session);
  } else if (running_.has_value()) {
    running_->episodes[0].rewards.push_back(inputs.reward);
    running_->episodes[0].served->sources.push_back(inputs.source);
  }
  if (!running_.has_value()) return;
  Episode& episode = running_->episodes[0];
  const History& history = session.history;
  const absl::Span<const float> observation = history.observation(history.size() - 1);
  episode.observations.insert(episode.observations.end(), observation.begin(), observation.end());
  episode.actions.push_back(answer.action);
  ServedEpisode& served = *episode.served;
  if (!served.answered_actions.empty()) served.answered_actions.push_back(answer.action);
  served.returns_to_go.push_back(answer.return_to_go);
  served.probabilities.insert(served.probabilities.end(), answer.probabilities.begin(),
                              answer.probabilities.end());
  served.spikes.push_back(answer.counts.total_spikes());
  served.noise.insert(served.noise.end(), inputs.noise.begin(), inputs.noise.end());
  if (!inputs.noise.empty()) {
    served.logits.insert(served.logits.end(), answer.logits.begin(), answer.logits.end());
  }
  if (episode.steps() > kLongestEpisode) CutOff();
}

void EpisodeRecorder::OnExecuted(const Action& executed) {
  if (!running_.has_value()) return;
  Episode& episode = running_->episodes[0];
  std::vector<Action>& answered = episode.served->answered_actions;
  if (answered.empty()) answered = episode.actions;
  episode.actions.back() = executed;
}

void EpisodeRecorder::Start(const Session& session) {
  last_ = nullptr;
  const Policy& policy = served_->policy();
  const SessionOptions& options = session.options;
  Episode episode;
  episode.actor = "served";
  episode.served = {.policy = options.policy,
                    .version = options.version,
                    .episode = session.episode,
                    .target_return = session.target_return,
                    .seed = options.seed,
                    .temperature = std::nullopt,
                    .learning = options.learning.has_value() || options.head_delta.size() > 0,
                    .labels = options.labels,
                    .answered_actions = {},
                    .sources = {},
                    .returns_to_go = {},
                    .probabilities = {},
                    .spikes = {},
                    .policy_sha256 = options.policy_sha256,
                    .session = session.id,
                    .tenant = options.tenant};
  if (options.action_selection.sample) {
    episode.served->temperature = options.action_selection.temperature;
  }
  running_ = Dataset{.environment = policy.environment,
                     .observation_size = policy.observation_size(),
                     .action_space = policy.action_space,
                     .recipe = {{"policy", options.policy}, {"version", options.version}},
                     .episodes = {}};
  AddNames("observation_names", policy.features.observation, &running_->recipe);
  AddNames("action_names", policy.features.action, &running_->recipe);
  running_->episodes.push_back(std::move(episode));
}

bool EpisodeRecorder::OnEpisodeEnd(const Session& session,
                                   const std::shared_ptr<FleetContribution>& /*contribution*/) {
  if (!running_.has_value()) return false;
  const EpisodeEnd& end = session.last_end->end;
  Episode& episode = running_->episodes[0];
  episode.rewards.push_back(end.reward);
  episode.served->sources.push_back(session.executed_source);
  if (end.observation.empty()) {
    episode.observations.resize(
        episode.observations.size() + static_cast<size_t>(running_->observation_size),
        std::numeric_limits<float>::quiet_NaN());
  } else {
    episode.observations.insert(episode.observations.end(), end.observation.begin(),
                                end.observation.end());
  }
  episode.terminated = end.terminated;
  episode.truncated = end.truncated || !end.terminated;
  PassToSink();
  return false;
}

void EpisodeRecorder::CutOff(bool terminated) {
  if (!running_.has_value()) return;
  Episode& episode = running_->episodes[0];
  ServedEpisode& served = *episode.served;
  const size_t steps = episode.rewards.size();
  episode.actions.pop_back();
  if (!served.answered_actions.empty()) served.answered_actions.pop_back();
  served.returns_to_go.pop_back();
  for (auto* values : {&served.probabilities, &served.logits, &served.noise}) {
    values->resize(values->size() / (steps + 1) * steps);
  }
  served.spikes.pop_back();
  episode.terminated = terminated;
  episode.truncated = !terminated;
  PassToSink();
}

void EpisodeRecorder::PassToSink() {
  Dataset dataset = *std::move(running_);
  running_.reset();
  ServedEpisode& served = *dataset.episodes[0].served;
  const bool is_plain =
      served.answered_actions.empty() &&
      std::all_of(served.sources.begin(), served.sources.end(),
                  [](const StepSource& source) { return source == StepSource(); });
  if (is_plain) served.sources.clear();
  last_ = dataset.episodes[0].steps() > 0 ? sink_(std::move(dataset)) : nullptr;
}

}  // namespace spikeserve
