#include "client/spikectl/agent.h"

#include <algorithm>
#include <chrono>
#include <limits>
#include <thread>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

absl::StatusOr<Action> ActionFromProto(const v1::Action& proto, const ActionSpace& space) {
  Action action;
  if (proto.has_discrete() && space.is_discrete()) {
    const bool fits = proto.discrete() >= 0 && proto.discrete() < space.n;
    action.discrete = fits ? static_cast<int>(proto.discrete()) : -1;
  } else if (proto.has_continuous() && !space.is_discrete()) {
    action.continuous.assign(proto.continuous().values().begin(),
                             proto.continuous().values().end());
  } else {
    return absl::InternalError("action: not of the environment's kind of action space");
  }
  if (absl::Status status = space.Contains(action); !status.ok()) {
    return absl::InternalError(absl::StrCat("the server's action: ", status.message()));
  }
  return action;
}

v1::Action ToProto(const Action& action, const ActionSpace& space) {
  v1::Action proto;
  if (space.is_discrete()) {
    proto.set_discrete(action.discrete);
  } else {
    proto.mutable_continuous()->mutable_values()->Assign(action.continuous.begin(),
                                                         action.continuous.end());
  }
  return proto;
}

std::optional<double> JoulesOf(const v1::DecisionStats& stats, EnergyModel model) {
  switch (model) {
    case EnergyModel::kHorowitz45nm:
      return stats.energy_joules();
    case EnergyModel::kInt45nm:
      if (stats.has_int_energy_joules()) return stats.int_energy_joules();
      break;
    case EnergyModel::kIntSram45nm:
      if (stats.has_int_sram_energy_joules()) return stats.int_sram_energy_joules();
      break;
    case EnergyModel::kSpike5pj:
      if (stats.has_spike_energy_joules()) return stats.spike_energy_joules();
      break;
  }
  return std::nullopt;
}

void Add(std::optional<double> joules, std::optional<double>* sum) {
  if (joules.has_value()) *sum = sum->value_or(0.0) + *joules;
}

void Count(const v1::DecisionStats& stats, EpisodeRecord* record) {
  ++record->steps;
  record->spikes += stats.spikes();
  for (int i = 0; i < kEnergyModels; ++i) {
    Add(JoulesOf(stats, static_cast<EnergyModel>(i)), &record->joules[static_cast<size_t>(i)]);
  }
}

}  // namespace

EpisodeRecord& EpisodeRecord::operator+=(const EpisodeRecord& other) {
  episode_return += other.episode_return;
  steps += other.steps;
  spikes += other.spikes;
  for (size_t i = 0; i < joules.size(); ++i) Add(other.joules[i], &joules[i]);
  latency.Merge(other.latency);
  return *this;
}

absl::StatusOr<EpisodeRecord> PlayEpisode(Environment& environment, RemoteSession& session,
                                          uint64_t seed, const PlayOptions& options) {
  EpisodeRecord record;
  const ActionSpace& space = environment.action_space();
  Arrivals arrivals(options.distance, space, seed);
  std::optional<v1::Action> executed;  // of the last step; absent: as decided
  const auto period = std::chrono::duration_cast<std::chrono::steady_clock::duration>(
      std::chrono::duration<double>(options.rate > 0.0 ? 1.0 / options.rate : 0.0));
  auto next = std::chrono::steady_clock::now();
  StepResult result{.observation = environment.Reset(seed)};
  while (!result.done()) {
    std::this_thread::sleep_until(next);
    next = std::max(next, std::chrono::steady_clock::now() - period) + period;
    const auto start = std::chrono::steady_clock::now();
    const auto response = session.Act(result.observation, result.reward, executed);
    const std::chrono::duration<double> latency = std::chrono::steady_clock::now() - start;
    if (!response.ok()) return response.status();
    ASSIGN_OR_RETURN(auto action, ActionFromProto(response->action(), space));
    record.latency.Add(latency.count());
    Count(response->stats(), &record);
    if (!options.distance.is_none()) {
      action = arrivals.Executed(std::move(action));
      executed = ToProto(action, space);
    }
    result = environment.Step(action);
    record.episode_return += result.reward;
  }
  RETURN_IF_ERROR((session.EndEpisode({.reward = result.reward,
                                       .terminated = result.terminated,
                                       .truncated = result.truncated,
                                       .observation = result.observation,
                                       .executed_action = executed}))
                      .status());
  return record;
}

absl::Status PlaySteps(Environment& environment, RemoteSession& session, uint64_t seed, int steps) {
  StepResult result{.observation = environment.Reset(seed)};
  for (int step = 0; step < steps && !result.done(); ++step) {
    ASSIGN_OR_RETURN(const auto response, session.Act(result.observation, result.reward));
    ASSIGN_OR_RETURN(const auto action,
                     ActionFromProto(response.action(), environment.action_space()));
    result = environment.Step(action);
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
