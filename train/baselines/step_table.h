// The steps of recorded episodes as rows of a regression: from the last observations to the action
// to imitate.
//
// Symbols: obs length of an observation, act outputs of the action head. Plain values; const
// members and functions are safe to call from many threads.
#pragma once

#include <vector>

#include "Eigen/Core"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/dataset/dataset.h"
#include "core/math/vector_view.h"
#include "train/data/episode_source.h"

namespace spikeserve {

// The number of observations that a row contains: a baseline reads the newest 1, 2 or 4 of them.
inline constexpr int kMostFrames = 4;

// The last kMostFrames observations of an episode, in a form in which small changes are not lost
// beside large values: o_t, o_t - o_{t-1}, o_{t-1} - o_{t-2}, ... Changes before the first step of
// the episode are 0. So the first k obs numbers contain the last k observations.
class FrameInput {
 public:
  explicit FrameInput(int observation_size)
      : size_(observation_size), input_(Eigen::VectorXf::Zero(kMostFrames * observation_size)) {}

  // Adds the observation of the next step [obs]. Returns the input of this step [kMostFrames obs].
  const Eigen::VectorXf& Push(absl::Span<const float> observation);

 private:
  const Eigen::Index size_;
  bool started_ = false;
  Eigen::VectorXf input_;
};

struct StepTable {
  std::vector<Episode> episodes;
  std::vector<int> begins;        // first row of each episode; last: the number of rows
  RowMajorMatrix<float> inputs;   // [rows, kMostFrames obs], see FrameInput
  RowMajorMatrix<float> targets;  // [rows, act], the actions to imitate, encoded
  Eigen::VectorXf weights;        // [rows], of the targets in the loss

  Eigen::Index rows() const { return inputs.rows(); }
};

// Reads the steps of the episodes of `source` with these indices. If they have more than `limit`
// steps, reads as many episodes, evenly spaced, as have about that number. Fails if a file can no
// longer be read. REQUIRES: at least one episode.
absl::StatusOr<StepTable> ReadSteps(const EpisodeSource& source, absl::Span<const int> episodes,
                                    int limit);

// Returns the rows of every second episode of `table`, from episode `first` (0 or 1) on, without
// the episodes themselves.
StepTable EverySecondEpisode(const StepTable& table, size_t first);

}  // namespace spikeserve
