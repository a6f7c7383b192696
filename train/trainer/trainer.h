// Trains a policy on recorded episodes with AdamW.
//
// Not thread-safe. Every random draw is a pure function of seed and iteration, so a run is
// determined by its options and the data. A run resumed from a checkpoint computes exactly the same
// weights as an uninterrupted one. Example:
//
//   EpisodeSource source(dataset);
//   Trainer trainer(InitialPolicy(config, source, seed), source, options);
//   while (!trainer.done()) trainer.Step();
//   WritePolicyFile(trainer.CurrentPolicy(), path);
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/enum_names.h"
#include "core/model/policy.h"
#include "train/data/chunk_plan.h"
#include "train/data/clip_sampler.h"
#include "train/data/episode_source.h"
#include "train/model/loss.h"
#include "train/model/patch_embedding.h"
#include "train/model/torch_model.h"
#include "train/neuron/surrogate.h"
#include "train/trainer/head_plasticity.h"

namespace spikeserve {

// The learning rate after the warm-up: a cosine that ends at 2 % of the peak, or the peak.
enum class Schedule { kCosine, kConstant };

constexpr std::array<EnumName<Schedule>, 2> EnumNames(Schedule) {
  return {{{Schedule::kCosine, "cosine"}, {Schedule::kConstant, "constant"}}};
}

// How training treats the norms of a policy: it keeps them, or lets them fade to affine maps, which
// leave a policy without norms.
enum class NormTraining { kLayer, kFade };

constexpr std::array<EnumName<NormTraining>, 2> EnumNames(NormTraining) {
  return {{{NormTraining::kLayer, "layer"}, {NormTraining::kFade, "fade"}}};
}

struct TrainOptions {
  uint64_t seed = 0;
  int iterations = 400;
  int batch = 32;                   // clips per iteration
  int clip_steps = 0;               // timesteps per clip; 0: the policy's context
  Padding padding = Padding::kEnd;  // of clips
  double learning_rate = 1e-3;      // the peak; the rate of omega and phi is 0.3 times it
  double weight_decay = 1e-4;       // not applied to omega and phi
  int warmup = 50;                  // iterations of linear warm-up
  Schedule schedule = Schedule::kCosine;
  double clip_norm = 1.0;      // largest norm of the whole gradient
  double action_noise = 0.0;   // probability that an action token is replaced by a random one
  DelayRange delay;            // steps until a decision is executed
  double validation = 0.1;     // share of each actor's episodes that is held out
  RateTargets rate_targets;    // the penalty grows linearly over the first third of the iterations
  double spike_penalty = 1.0;  // weight of the penalty on firing rates
  double operation_penalty = 0.0;  // weight of the penalty on synaptic operations; grows alike
  // Of the whole process. The number decides the order of sums, and so the last bits of the
  // weights. On a busy machine, or with small models, one thread is the fastest.
  int threads = 1;
  torch::Device device = torch::kCPU;  // other devices compute other last bits
  Surrogate surrogate;
  PatchShape patches;                            // of image observations; only for new policies
  Arithmetic arithmetic = Arithmetic::kFloat32;  // of the forward pass and of the policy it makes
  NormTraining norm = NormTraining::kLayer;      // kFade: gone after 70 % of the iterations
  HeadPlasticity plasticity;
  // Tensors of the policy that keep their values, by name or by a part of it between dots:
  // `head`, `layers.0.routing.hidden`, `routing.hidden`.
  std::vector<std::string> frozen;

  // Returns INVALID_ARGUMENT with the option, the expected and the received value.
  absl::Status Validate() const;

  // Returns the flags of `spiketrain train` for these options, including defaults except those of
  // `padding`, `schedule`, `arithmetic`, `patches`, `norm`, `delay`, `plasticity`, `frozen`,
  // `threads` and `device`.
  std::string ToFlags() const;
};

// Returns INVALID_ARGUMENT if a name of TrainOptions::frozen is that of no tensor of the policy.
absl::Status CheckFrozen(const std::vector<std::string>& frozen, const Policy& policy);

class Trainer {
 public:
  // Keeps a reference to `source`. REQUIRES: valid options, whose frozen tensors the policy has,
  // and a valid policy in float32 for the source's environment that CheckDevice() accepts; with
  // Arithmetic::kInteger one that QuantizeToInteger() accepts, with NormTraining::kFade one with
  // norms and spikes. `sources` are words that identify the files that the run reads, each after a
  // space; checkpoints of other words are refused. Sets the number of threads of libtorch in this
  // process.
  Trainer(Policy initial, const EpisodeSource& source, const TrainOptions& options,
          const std::string& sources = "");
  ~Trainer();

  struct StepReport {
    double loss = 0.0;       // imitation loss
    double mean_loss = 0.0;  // its running mean
    double hinge = 0.0;      // sum of the excess of firing rates over their targets
  };
  // Reads the episodes that the next Step() and ValidationLoss() need, if the source is not
  // resident. Fails if a file can no longer be read. Needs to be called before each of them only if
  // the source is not resident.
  absl::Status ReadEpisodes();

  // Runs one iteration: draws a batch of clips and updates the weights. Returns INVALID_ARGUMENT,
  // which names the tensor, if integers cannot hold the new weights with Arithmetic::kInteger.
  // REQUIRES: !done().
  absl::StatusOr<StepReport> Step();

  // Returns whether any episodes are held out.
  bool has_validation() const { return !split_.validation.empty(); }
  // Returns the imitation loss on clips of held-out episodes; uses the same clips in every call.
  // REQUIRES: has_validation().
  double ValidationLoss() const;

  int iteration() const { return iteration_; }
  bool done() const { return iteration_ >= options_.iterations; }
  // Returns the policy with the current weights, in the arithmetic of the options. REQUIRES:
  // done(), with NormTraining::kFade.
  Policy CurrentPolicy() const { return model_.CurrentPolicy(); }

  // Writes weights, moments of norms that fade, optimiser state, iteration and mean loss; there is
  // no other state, because random draws depend only on seed and iteration. Replaces the file at
  // `path` atomically. Returns INTERNAL if it cannot be written.
  absl::Status SaveCheckpoint(const std::string& path) const;
  // Restores a checkpoint. Returns NOT_FOUND if the file does not exist, and FAILED_PRECONDITION,
  // without changing the weights or the iteration, if it belongs to a run with other options, data
  // or model; the message names what differs.
  absl::Status LoadCheckpoint(const std::string& path);

 private:
  struct Optimizer;

  // A batch of clips as tensors, see Clips.
  struct Batch {
    ClipTensors clips;
    torch::Tensor targets;  // [B, n, act]
    torch::Tensor mask;     // [B, n]
    torch::Tensor weights;  // [B, n]
  };
  Batch MakeBatch(const Clips& clips) const;
  uint64_t ValidationKey(uint64_t batch) const;
  // Reads the clips of ValidationLoss().
  absl::Status ReadValidation();
  torch::Tensor Loss(const Batch& batch, const ModelOutput& output) const;
  // Applies the local rule of the head to a batch, whose `output` is from before AdamW's step.
  void LearnLocally(const Batch& batch, const ModelOutput& output);
  void SetLearningRate();
  // Sets the share of LayerNorm in norms that fade.
  void SetNormShare();
  // Returns all tensors of a checkpoint but the optimiser's, by name.
  std::map<std::string, torch::Tensor> State() const;

  const EpisodeSource& source_;
  const TrainOptions options_;
  // Identify the run in its checkpoints.
  const std::string run_;     // options and recipe of the data
  const std::string origin_;  // initial policy and files
  const ModelConfig config_;
  const ActionSpace action_space_;
  const int observation_size_;
  const ClipShape clip_;
  const Split split_;
  const torch::Tensor spread_;  // deviations of the encoded targets of a Box, [act]
  TorchModel model_;
  std::vector<Clips> validation_;       // the clips of ValidationLoss(); empty until they are read
  std::unique_ptr<ChunkPlan> plan_;     // null if the source is resident
  ChunkPlan::Chunk chunk_;              // what `resident_` holds
  Dataset resident_;                    // empty if the source is resident
  std::unique_ptr<ClipSampler> clips_;  // draws from the episodes in memory
  std::unique_ptr<Optimizer> optimizer_;
  int iteration_ = 0;
  double mean_loss_ = -1.0;  // -1: no iteration yet
};

}  // namespace spikeserve
