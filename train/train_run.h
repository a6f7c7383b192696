// One training: from data and an initial policy to a policy file, as `spiketrain train` does it.
//
// Free functions without shared state. Errors name the flag or the file.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/model/policy.h"
#include "train/data/episode_source.h"
#include "train/loss_gate.h"
#include "train/record_flags.h"
#include "train/train_flags.h"
#include "train/train_summary.h"

namespace spikeserve {

// The flags of `spiketrain train`.
struct TrainFlags {
  std::string out;
  std::vector<std::string> data;   // none: record as `spiketrain dataset` would
  int data_memory = 4096;          // MiB
  std::string init;                // initial policy file; empty: random weights
  std::optional<std::string> env;  // absent: that of the data, or CartPole-v1
  ShapeFlags shape;
  std::optional<int> lookback;           // absent: random phase generators
  std::optional<int> mirror;             // the same; not both
  bool activity_router = false;          // the routing sees the mean output of each head alone
  std::vector<std::string> image_shape;  // height, width, channels; none: not an image
  int patch_size = 0;                    // 0: no patches
  int patch_features = 8;
  std::optional<double> target_return;  // absent: that of --init, the environment or the data
  std::optional<double> return_offset;  // absent: the default of the environment
  std::optional<double> return_scale;
  TrainerFlags trainer;
  std::vector<std::string> seeds;  // of several trainings; none: one training
  RecordFlags record;
  int episodes = 100;           // of the evaluation at the end
  bool no_baselines = false;    // do not compare the policy with baselines
  LossGate gate;                // of --arithmetic=integer with --init
  Grade require = Grade::kBad;  // least verdict with which the command succeeds
  bool resume = false;
  bool overwrite = false;
  int checkpoint_every = 100;
  int validate_every = 50;
  bool json = false;
};

// Refuses to replace a policy or a checkpoint in --out without --overwrite. With --resume, a run
// continues from its checkpoint.
absl::Status CheckOut(const TrainFlags& flags);

// Reads the files of --data, or without that flag records data with the default recipe into --out.
absl::StatusOr<EpisodeSource> MakeSource(const TrainFlags& flags);

// Returns INVALID_ARGUMENT, which names the flag, if no decision of the episodes for training has a
// weight in the loss, or if no episode is long enough for a decision to be executed.
absl::Status CheckSource(const TrainOptions& options, const EpisodeSource& source);

// What to do if the integers lost too much.
extern const char kLossAdvice[];

// The outcome of a training.
struct TrainedPolicy {
  Policy policy;
  TrainSummary summary;
};

// Trains a policy on `source`, evaluates it, and writes policy.safetensors and checkpoint.pt to
// --out, a directory that it makes. `command_line` becomes a part of the policy's record. A policy
// in integers that lost too much of what the float32 one of --init returns is not written: the
// checkpoint is, from which --resume --allow_loss writes it.
absl::StatusOr<TrainedPolicy> TrainPolicy(const TrainFlags& flags, const EpisodeSource& source,
                                          const std::string& command_line);

// Trains with each of --seeds into --out/seed-N, one after the other, and prints the return of each
// policy, their mean and their standard deviation. All policies play the same starts, from seed
// 1,000,000 on, which no final evaluation uses. Copies the policy with the highest mean return to
// --out/policy.safetensors. Returns INVALID_ARGUMENT if a seed is not a number or not unique, if
// spiketrain cannot play the environment, or, before anything is recorded or trained, if CheckOut()
// refuses --out or the directory of a seed.
absl::Status TrainSeeds(const TrainFlags& flags, const std::string& command_line);

}  // namespace spikeserve
