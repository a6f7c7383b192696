// Draws random clips, runs of n consecutive timesteps, from recorded episodes.
//
// Symbols: B clips, n timesteps per clip, obs length of an observation, act outputs of the action
// head.
#ifndef TRAIN_DATA_CLIP_SAMPLER_H_
#define TRAIN_DATA_CLIP_SAMPLER_H_

#include <cstdint>
#include <vector>

#include "train/data/dataset.h"

namespace spikeserve {

// A batch of clips as row-major arrays. At timesteps after the end of an episode `mask` is 0 and
// all other arrays but `timesteps` are 0.
struct Clips {
  int count = 0;                    // B
  int timesteps_per_clip = 0;       // n
  std::vector<float> return_to_go;  // [B, n], environment units
  std::vector<float> observations;  // [B, n, obs], environment units
  std::vector<float> actions;      // [B, n, act], the action tokens, encoded by ActionSpace::Encode
  std::vector<float> targets;      // [B, n, act], the actions to imitate, encoded likewise
  std::vector<int64_t> timesteps;  // [B, n], counted from the start of the episode
  std::vector<float> mask;         // [B, n], 1 for a step of the episode, 0 after its end
  std::vector<float> weights;      // [B, n], weights of the targets in the loss; 0 after the end
};

// Immutable after construction; const members are safe to call from many threads.

class ClipSampler {
 public:
  // Draws clips of `timesteps` timesteps from the episodes of `dataset` with these indices. Keeps a
  // reference to `dataset`. REQUIRES: at least one episode.
  ClipSampler(const Dataset& dataset, std::vector<int> episodes, int timesteps);

  // Draws `count` clips; a pure function of `key` and the other arguments. For each clip draws one
  // step uniformly from all steps of the episodes, then the clip's first step uniformly from the n
  // positions at which the clip contains that step, clamped to the start of the episode. Replaces
  // each action token by a random action with probability `action_noise`; the targets are not
  // changed.
  Clips Sample(uint64_t key, int count, double action_noise) const;

 private:
  struct Place {
    int episode;
    int begin;
  };
  Place Draw(uint64_t key) const;
  void Fill(const Place& place, int clip, Clips* clips) const;
  void AddActionNoise(uint64_t key, double action_noise, Clips* clips) const;

  const Dataset& dataset_;
  const std::vector<int> episodes_;
  const int timesteps_;
  std::vector<int64_t> steps_before_;  // per episode: steps in those before it; last: total
  std::vector<std::vector<float>> returns_to_go_;  // per episode
};

// Indices of the episodes for training and for validation.
struct Split {
  std::vector<int> training;
  std::vector<int> validation;
};
// Holds out the last `fraction` of each actor's episodes for validation, rounded up but never all
// of them.
Split SplitEpisodes(const Dataset& dataset, double fraction);

}  // namespace spikeserve

#endif  // TRAIN_DATA_CLIP_SAMPLER_H_
