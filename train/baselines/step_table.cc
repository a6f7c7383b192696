#include "train/baselines/step_table.h"

#include <algorithm>
#include <cstdint>
#include <utility>

#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// Returns every n-th of `episodes`, for the smallest n with which they have at most `limit` steps,
// but at least one.
std::vector<int> EvenlySpaced(const EpisodeSource& source, absl::Span<const int> episodes,
                              int limit) {
  int64_t steps = 0;
  for (const int index : episodes) steps += source.entries()[index].steps;
  const auto stride = static_cast<size_t>(std::max<int64_t>(1, (steps + limit - 1) / limit));
  std::vector<int> chosen;
  for (size_t i = 0; i < episodes.size(); i += stride) chosen.push_back(episodes[i]);
  return chosen;
}

}  // namespace

const Eigen::VectorXf& FrameInput::Push(absl::Span<const float> observation) {
  const auto newest = AsVector(observation);
  if (std::exchange(started_, true)) {
    const Eigen::Index kept = (kMostFrames - 2) * size_;
    const Eigen::VectorXf changes = input_.segment(size_, kept);
    input_.tail(kept) = changes;
    input_.segment(size_, size_) = newest - input_.head(size_);
  }
  input_.head(size_) = newest;
  return input_;
}

absl::StatusOr<StepTable> ReadSteps(const EpisodeSource& source, absl::Span<const int> episodes,
                                    int limit) {
  SPIKESERVE_DCHECK(!episodes.empty());
  ASSIGN_OR_RETURN(std::vector<Episode> read, source.Read(EvenlySpaced(source, episodes, limit)));
  const Dataset& dataset = source.dataset();
  const int obs = dataset.observation_size, act = dataset.action_space.size();
  StepTable table;
  table.episodes = std::move(read);
  int rows = 0;
  for (const Episode& episode : table.episodes) {
    table.begins.push_back(rows);
    rows += episode.steps();
  }
  table.begins.push_back(rows);
  table.inputs.resize(rows, kMostFrames * obs);
  table.targets.resize(rows, act);
  table.weights.resize(rows);
  Eigen::Index row = 0;
  for (const Episode& episode : table.episodes) {
    FrameInput frames(obs);
    for (int step = 0; step < episode.steps(); ++step, ++row) {
      const auto begin = static_cast<size_t>(step) * obs;
      table.inputs.row(row) =
          frames.Push(absl::MakeConstSpan(episode.observations).subspan(begin, obs)).transpose();
      dataset.action_space.Encode(episode.label(step),
                                  {table.targets.row(row).data(), static_cast<size_t>(act)});
      table.weights[row] = episode.weight(step);
    }
  }
  return table;
}

StepTable EverySecondEpisode(const StepTable& table, size_t first) {
  StepTable half;
  std::vector<int> rows;
  for (size_t i = first; i + 1 < table.begins.size(); i += 2) {
    half.begins.push_back(static_cast<int>(rows.size()));
    for (int row = table.begins[i]; row < table.begins[i + 1]; ++row) rows.push_back(row);
  }
  half.begins.push_back(static_cast<int>(rows.size()));
  half.inputs = table.inputs(rows, Eigen::all);
  half.targets = table.targets(rows, Eigen::all);
  half.weights = table.weights(rows);
  return half;
}

}  // namespace spikeserve
