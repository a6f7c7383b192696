// Draws clips of N timesteps from recorded episodes.
//
// Symbols: B clips, n timesteps of a clip, obs observation length, act action head outputs.
#ifndef TRAIN_DATA_CLIP_SAMPLER_H_
#define TRAIN_DATA_CLIP_SAMPLER_H_

#include <cstdint>
#include <vector>

#include "train/data/dataset.h"

namespace spikeserve {

// Row-major arrays. Where an episode ends before its clip, `mask` is 0 and the rest zero.
struct Clips {
  int count = 0;                    // B
  int timesteps_per_clip = 0;       // n
  std::vector<float> return_to_go;  // [B, n], environment units
  std::vector<float> observations;  // [B, n, obs], environment units
  std::vector<float> actions;       // [B, n, act], as ActionSpace::Encode writes them: the tokens
  std::vector<float> targets;       // [B, n, act], the same: what to imitate
  std::vector<int64_t> timesteps;   // [B, n], within the episode
  std::vector<float> mask;          // [B, n], 1 where there is a step
  std::vector<float> weights;       // [B, n], of the targets in the loss; 0 where there is no step
};

class ClipSampler {
 public:
  // Clips of `timesteps` from the episodes with these indices. Keeps a reference to `dataset`.
  // REQUIRES: at least one episode.
  ClipSampler(const Dataset& dataset, std::vector<int> episodes, int timesteps);

  // `count` clips, a pure function of `key`: an episode by its length, in it a uniform step, and
  // the clip's begin uniform among the n that hold that step (but not before the episode's). With
  // probability `action_noise` an action token is replaced by a random one; targets stay.
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
  std::vector<int64_t> steps_before_;              // steps in episodes before each, then in all
  std::vector<std::vector<float>> returns_to_go_;  // per episode
};

// Episode indices for training and for validation: of each actor's episodes, the last `fraction`
// (rounded up, but never all) is held out.
struct Split {
  std::vector<int> training;
  std::vector<int> validation;
};
Split SplitEpisodes(const Dataset& dataset, double fraction);

}  // namespace spikeserve

#endif  // TRAIN_DATA_CLIP_SAMPLER_H_
