// Records offline data for training. There are four kinds of episodes. The paper's recipe uses the
// first two:
//
//   expert     the expert's actions
//   random     uniformly random actions
//   disturbed  the expert's actions, interrupted by bursts of random ones; they show how to recover
//   student    a trained policy's actions; they show the states that this policy reaches
//
// Student episodes implement DAgger (S. Ross, G. Gordon, D. Bagnell, AISTATS 2011). In disturbed
// and student episodes the expert's action is the label of every step.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "core/model/policy.h"
#include "train/data/dataset.h"
#include "train/expert/expert.h"

namespace spikeserve {

// Data are recorded from environment seeds below this one. The seeds from it on are never used for
// training and are reserved for evaluation.
inline constexpr uint64_t kFirstEvaluationSeed = 1'000'000;

// Bounds of the label weights, see RecordOptions::weigh.
inline constexpr double kLeastWeight = 0.15;
inline constexpr double kMostWeight = 3.0;

struct RecordOptions {
  ExpertOptions expert = {};  // also names the environment
  uint64_t seed = 0;
  int steps = 10'000;               // lower bound: every episode is recorded to its end
  double expert_fraction = 0.5;     // share of the steps from expert episodes
  double disturbed_fraction = 0.0;  // share from disturbed episodes; the rest is student or random
  std::shared_ptr<const Policy> student = nullptr;  // null: the rest is random
  // Weights every label by Expert::StateImportance(), clamped to [kLeastWeight, kMostWeight].
  // False: all weights are 1.
  bool weigh = false;

  // Upper bound of the burst rate, the probability that a burst begins at a step outside one. Each
  // disturbed episode draws its own rate below it. A burst is 1 to `longest_burst` random actions.
  double burst_rate = 0.3;
  int longest_burst = 8;
  // Share of the disturbed episodes that start at any velocity that the environment allows, instead
  // of the small ones of Reset. For Pendulum-v1 and PositionOnlyPendulum-v1 only.
  double wide_start_fraction = 0.0;

  absl::Status Validate() const;

  // Returns the flags of `spiketrain dataset` for these options, without the seed, the tables'
  // directory and the student, whose path is not known here.
  std::string ToFlags() const;
};

// Records whole episodes: of the expert, then disturbed ones, then of the student, or random ones
// without a student, until each kind has its share of the steps. In disturbed and student episodes
// `actions` holds the executed actions and `labels` the expert's. A pure function of the options.
// Returns NOT_FOUND for an unknown environment or expert, INVALID_ARGUMENT for invalid options or a
// student that does not fit the environment.
absl::StatusOr<Dataset> RecordDataset(const RecordOptions& options);

}  // namespace spikeserve
