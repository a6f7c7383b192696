// Trains a policy on recorded episodes with AdamW.
//
// Not thread-safe. Every draw is a pure function of seed and iteration, so a run is determined by
// its options, the data and the number of threads; a run resumed from a checkpoint goes on exactly
// as the uninterrupted one.
#ifndef TRAIN_TRAINER_TRAINER_H_
#define TRAIN_TRAINER_TRAINER_H_

#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "core/model/policy.h"
#include "train/data/clip_sampler.h"
#include "train/data/dataset.h"
#include "train/model/loss.h"
#include "train/model/surrogate.h"
#include "train/model/torch_model.h"

namespace spikeserve {

struct TrainOptions {
  uint64_t seed = 0;
  int iterations = 400;
  int batch = 32;               // clips an iteration
  int clip_steps = 0;           // timesteps of a clip; 0 for the policy's context
  double learning_rate = 1e-3;  // peak; omega and phi get 0.3 of it
  double weight_decay = 1e-4;   // not on omega and phi
  int warmup = 50;              // iterations of linear warm-up, then a cosine to 2 % at the end
  double clip_norm = 1.0;       // of the whole gradient
  double action_noise = 0.0;    // probability that an action token is replaced by a random one
  double validation = 0.1;      // share of each actor's episodes held out
  RateTargets rate_targets;     // ramped in over the first third
  double spike_penalty = 1.0;   // weight of the rate hinge
  Surrogate surrogate;

  // INVALID_ARGUMENT names the option, what was expected and what came.
  absl::Status Validate() const;

  // The flags of `spiketrain train` that ask for these options, with every value.
  std::string ToFlags() const;
};

class Trainer {
 public:
  // Keeps a reference to `dataset`. REQUIRES: valid options, and a valid policy for the dataset's
  // environment.
  Trainer(Policy initial, const Dataset& dataset, const TrainOptions& options);
  ~Trainer();

  struct StepReport {
    double loss = 0.0;   // imitation
    double hinge = 0.0;  // summed excess of firing rates over their targets
  };
  StepReport Step();

  bool has_validation() const { return validation_ != nullptr; }
  // The imitation loss on held-out episodes, on the same clips every time. REQUIRES:
  // has_validation().
  double ValidationLoss() const;

  int iteration() const { return iteration_; }
  bool done() const { return iteration_ >= options_.iterations; }
  Policy CurrentPolicy() const { return model_.CurrentPolicy(); }

  // Weights, optimiser and iteration; the random state is the seed and the iteration. Written
  // beside `path`, then renamed.
  absl::Status SaveCheckpoint(const std::string& path) const;
  // FAILED_PRECONDITION if the checkpoint is of a run with other options, data or model; what was
  // trained so far is kept then.
  absl::Status LoadCheckpoint(const std::string& path);

 private:
  struct Optimizer;

  // Clips as tensors, with what to imitate [B, n, act], where there is a step [B, n] and what it
  // weighs [B, n].
  struct Batch {
    ClipTensors clips;
    torch::Tensor targets;
    torch::Tensor mask;
    torch::Tensor weights;
  };
  Batch MakeBatch(const ClipSampler& sampler, uint64_t key, double action_noise) const;
  torch::Tensor Loss(const Batch& batch, const ModelOutput& output) const;
  void SetLearningRate();

  const TrainOptions options_;
  const std::string run_;  // options and data, as a checkpoint is marked with
  const ActionSpace action_space_;
  const int observation_size_;
  TorchModel model_;
  ClipSampler training_;
  std::unique_ptr<ClipSampler> validation_;  // null where too few episodes
  std::unique_ptr<Optimizer> optimizer_;
  int iteration_ = 0;
};

}  // namespace spikeserve

#endif  // TRAIN_TRAINER_TRAINER_H_
