#include "train/data/clip_sampler.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

// The draws made for one clip; each kind uses random numbers of its own.
enum DrawKind : uint64_t { kStep = 1, kOffset = 2, kNoise = 3, kNoiseAction = 4 };

uint64_t Below(uint64_t bits, uint64_t bound) { return bits % bound; }

}  // namespace

ClipSampler::ClipSampler(const Dataset& dataset, std::vector<int> episodes, int timesteps)
    : dataset_(dataset), episodes_(std::move(episodes)), timesteps_(timesteps) {
  int64_t steps = 0;
  for (const int index : episodes_) {
    steps_before_.push_back(steps);
    steps += dataset_.episodes[index].steps();
    returns_to_go_.push_back(ReturnsToGo(dataset_.episodes[index]));
  }
  steps_before_.push_back(steps);
}

Clips ClipSampler::Sample(uint64_t key, int count, double action_noise) const {
  const size_t slots = static_cast<size_t>(count) * timesteps_;
  Clips clips = {.count = count,
                 .timesteps_per_clip = timesteps_,
                 .return_to_go = std::vector<float>(slots),
                 .observations = std::vector<float>(slots * dataset_.observation_size),
                 .actions = std::vector<float>(slots * dataset_.action_space.size()),
                 .targets = std::vector<float>(slots * dataset_.action_space.size()),
                 .timesteps = std::vector<int64_t>(slots),
                 .mask = std::vector<float>(slots),
                 .weights = std::vector<float>(slots)};
  for (int clip = 0; clip < count; ++clip) {
    Fill(Draw(RandomBits({key, static_cast<uint64_t>(clip)})), clip, &clips);
  }
  if (action_noise > 0.0) AddActionNoise(key, action_noise, &clips);
  return clips;
}

ClipSampler::Place ClipSampler::Draw(uint64_t key) const {
  const auto step = static_cast<int64_t>(
      Below(RandomBits({key, kStep}), static_cast<uint64_t>(steps_before_.back())));
  const auto after = std::upper_bound(steps_before_.begin(), steps_before_.end(), step);
  const auto episode = static_cast<int>(after - steps_before_.begin()) - 1;
  const auto offset =
      static_cast<int64_t>(Below(RandomBits({key, kOffset}), static_cast<uint64_t>(timesteps_)));
  const int64_t begin = std::max<int64_t>(0, step - steps_before_[episode] - offset);
  return {.episode = episode, .begin = static_cast<int>(begin)};
}

void ClipSampler::Fill(const Place& place, int clip, Clips* clips) const {
  const Episode& episode = dataset_.episodes[episodes_[place.episode]];
  const size_t obs = dataset_.observation_size;
  const size_t act = dataset_.action_space.size();
  for (int i = 0; i < timesteps_; ++i) {
    const size_t slot = static_cast<size_t>(clip) * timesteps_ + i;
    const int step = place.begin + i;
    clips->timesteps[slot] = step;
    if (step >= episode.steps()) continue;
    clips->mask[slot] = 1.0f;
    clips->weights[slot] = episode.weight(step);
    clips->return_to_go[slot] = returns_to_go_[place.episode][step];
    std::copy_n(episode.observations.begin() + static_cast<int64_t>(step * obs), obs,
                clips->observations.begin() + static_cast<int64_t>(slot * obs));
    const absl::Span<float> target = absl::MakeSpan(clips->targets).subspan(slot * act, act);
    dataset_.action_space.Encode(episode.label(step), target);
    dataset_.action_space.Encode(episode.actions[step],
                                 absl::MakeSpan(clips->actions).subspan(slot * act, act));
  }
}

void ClipSampler::AddActionNoise(uint64_t key, double action_noise, Clips* clips) const {
  const ActionSpace& space = dataset_.action_space;
  const size_t act = space.size();
  for (size_t slot = 0; slot < clips->mask.size(); ++slot) {
    if (clips->mask[slot] == 0.0f) continue;
    if (UniformDouble(RandomBits({key, kNoise, slot})) >= action_noise) continue;
    const absl::Span<float> token = absl::MakeSpan(clips->actions).subspan(slot * act, act);
    if (space.is_discrete()) {
      space.Encode({.discrete = static_cast<int>(
                        Below(RandomBits({key, kNoiseAction, slot}), static_cast<uint64_t>(act))),
                    .continuous = {}},
                   token);
      continue;
    }
    for (size_t i = 0; i < act; ++i) {
      token[i] = 2.0f * UniformFloat(RandomBits({key, kNoiseAction, slot, i})) - 1.0f;
    }
  }
}

Split SplitEpisodes(const Dataset& dataset, double fraction) {
  std::map<std::string, std::vector<int>> by_actor;
  for (size_t i = 0; i < dataset.episodes.size(); ++i) {
    by_actor[dataset.episodes[i].actor].push_back(static_cast<int>(i));
  }
  Split split;
  for (const auto& [actor, indices] : by_actor) {
    const auto wanted =
        static_cast<size_t>(std::ceil(fraction * static_cast<double>(indices.size())));
    const size_t held_out = std::min(wanted, indices.size() - 1);
    const auto middle = indices.end() - static_cast<int64_t>(held_out);
    split.training.insert(split.training.end(), indices.begin(), middle);
    split.validation.insert(split.validation.end(), middle, indices.end());
  }
  return split;
}

}  // namespace spikeserve
