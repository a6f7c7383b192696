#include "client/spikectl/agent.h"

#include <chrono>
#include <limits>
#include <vector>

#include "absl/strings/str_cat.h"

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

void Count(const v1::DecisionStats& stats, EpisodeRecord* record) {
  ++record->steps;
  record->spikes += stats.spikes();
  record->energy_joules += stats.energy_joules();
  record->horowitz_energy_joules += stats.horowitz_energy_joules();
}

}  // namespace

EpisodeRecord& EpisodeRecord::operator+=(const EpisodeRecord& other) {
  episode_return += other.episode_return;
  steps += other.steps;
  spikes += other.spikes;
  energy_joules += other.energy_joules;
  horowitz_energy_joules += other.horowitz_energy_joules;
  latency.Merge(other.latency);
  return *this;
}

absl::StatusOr<EpisodeRecord> PlayEpisode(Environment& environment, RemoteSession& session,
                                          uint64_t seed) {
  EpisodeRecord record;
  StepResult result{.observation = environment.Reset(seed)};
  while (!result.done()) {
    const auto start = std::chrono::steady_clock::now();
    const auto response = session.Act(result.observation, result.reward);
    const std::chrono::duration<double> latency = std::chrono::steady_clock::now() - start;
    if (!response.ok()) return response.status();
    const auto action = ActionFromProto(response->action(), environment.action_space());
    if (!action.ok()) return action.status();
    record.latency.Add(latency.count());
    Count(response->stats(), &record);
    result = environment.Step(*action);
    record.episode_return += result.reward;
  }
  const auto end = session.EndEpisode({.reward = result.reward,
                                       .terminated = result.terminated,
                                       .truncated = result.truncated,
                                       .observation = result.observation});
  if (!end.ok()) return end.status();
  return record;
}

absl::Status PlaySteps(Environment& environment, RemoteSession& session, uint64_t seed, int steps) {
  StepResult result{.observation = environment.Reset(seed)};
  for (int step = 0; step < steps && !result.done(); ++step) {
    const auto response = session.Act(result.observation, result.reward);
    if (!response.ok()) return response.status();
    const auto action = ActionFromProto(response->action(), environment.action_space());
    if (!action.ok()) return action.status();
    result = environment.Step(*action);
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
