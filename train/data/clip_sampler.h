// Draws random clips, runs of n consecutive timesteps, from recorded episodes.
//
// Symbols: B clips, n timesteps per clip, obs length of an observation, act outputs of the action
// head.
#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/enum_names.h"
#include "train/data/dataset.h"
#include "train/data/delay_range.h"
#include "train/data/episode_source.h"

namespace spikeserve {

// Where a clip has no steps of its episode: after the last one, or before the first one as in the
// paper's section 5.1. Attention is causal, so it never sees what lies after a step, but it sees
// what lies before it: with kFront a policy also learns from tokens that are 0.
enum class Padding { kEnd, kFront };

constexpr std::array<EnumName<Padding>, 2> EnumNames(Padding) {
  return {{{Padding::kEnd, "end"}, {Padding::kFront, "front"}}};
}

// What all clips of a sampler have in common.
struct ClipShape {
  int timesteps = 1;  // n >= 1
  Padding padding = Padding::kEnd;
  DelayRange delay = {};  // each clip draws a delay of its own
};

// A batch of clips as row-major arrays. At timesteps outside an episode `mask` is 0 and all other
// arrays but `timesteps` are 0.
struct Clips {
  int count = 0;                    // B
  int timesteps_per_clip = 0;       // n
  std::vector<float> return_to_go;  // [B, n], environment units
  std::vector<float> observations;  // [B, n, obs], environment units
  std::vector<float> actions;      // [B, n, act], the action tokens, encoded by ActionSpace::Encode
  std::vector<float> targets;      // [B, n, act], the actions to imitate, encoded likewise
  std::vector<int64_t> timesteps;  // [B, n], counted from the start of the episode; 0 before it
  std::vector<float> mask;         // [B, n], 1 for a step of the episode, 0 outside
  std::vector<float> weights;      // [B, n], weights of the targets in the loss; 0 outside
  // [B, obs], the observation before the clip; at the start of an episode, its first observation.
  std::vector<float> previous;
};

// The classes are immutable after construction; const members are safe to call from many threads.

// Draws where clips are, in episodes of which only the lengths are known.
class ClipPlaces {
 public:
  struct Place {
    int episode;  // index into the lengths
    int begin;    // first step of the clip; below 0 if zeros are before the first step
  };

  // REQUIRES: at least one episode.
  ClipPlaces(const std::vector<int>& lengths, const ClipShape& shape);

  // Draws clip number `clip` of those with this key. Draws one step uniformly from all steps of the
  // episodes, then the clip's place uniformly from the n places at which it contains that step,
  // moved to the start of the episode if it begins before it, or, with Padding::kFront, to its end
  // if it ends after it.
  Place Draw(uint64_t key, int clip) const;

 private:
  const int timesteps_;
  const Padding padding_;
  std::vector<int64_t> steps_before_;  // per episode: steps in those before it; last: total
};

// Draws clips from episodes that are in memory.
class ClipSampler {
 public:
  // Draws clips from the episodes of `dataset` with these indices. Keeps a reference to `dataset`.
  // REQUIRES: at least one episode.
  ClipSampler(const Dataset& dataset, std::vector<int> episodes, const ClipShape& shape);

  // Draws `count` clips at the places of ClipPlaces; a pure function of `key` and the other
  // arguments. Replaces each action token by a random action with probability `action_noise`; the
  // targets are not changed.
  Clips Sample(uint64_t key, int count, double action_noise) const;

 private:
  void AddActionNoise(uint64_t key, double action_noise, Clips* clips) const;

  const Dataset& dataset_;
  const std::vector<int> episodes_;
  const ClipShape shape_;
  const ClipPlaces places_;
  std::vector<std::vector<float>> returns_to_go_;  // per episode
};

// Returns what ClipSampler::Sample() returns without action noise for the episodes of `source` with
// these indices. Reads only the episodes in which the clips are, one at a time, if `source` is not
// resident. REQUIRES: at least one episode.
absl::StatusOr<Clips> ReadClips(const EpisodeSource& source, const std::vector<int>& episodes,
                                const ClipShape& shape, uint64_t key, int count);

// Indices of the episodes for training and for validation.
struct Split {
  std::vector<int> training;
  std::vector<int> validation;
};
// Holds out the last `fraction` of each actor's episodes for validation, rounded up but never all
// of them.
Split SplitEpisodes(const std::vector<EpisodeEntry>& entries, double fraction);

}  // namespace spikeserve
