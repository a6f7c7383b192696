#include "train/data/clip_sampler.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

// The draws made for one clip; each kind uses random numbers of its own.
enum DrawKind : uint64_t { kStep = 1, kOffset = 2, kNoise = 3, kNoiseAction = 4, kDelay = 5 };

uint64_t Below(uint64_t bits, uint64_t bound) { return bits % bound; }

// Draws the delay of clip number `clip` of those with this key.
int DrawDelay(DelayRange range, uint64_t key, int clip) {
  const uint64_t bits = RandomBits({RandomBits({key, static_cast<uint64_t>(clip)}), kDelay});
  return range.least +
         static_cast<int>(Below(bits, static_cast<uint64_t>(range.most - range.least) + 1));
}

std::vector<int> LengthsOf(const Dataset& dataset, const std::vector<int>& episodes) {
  std::vector<int> lengths;
  for (const int index : episodes) lengths.push_back(dataset.episodes[index].steps());
  return lengths;
}

Clips EmptyClips(const Dataset& dataset, int count, int timesteps) {
  const size_t slots = static_cast<size_t>(count) * timesteps;
  return {.count = count,
          .timesteps_per_clip = timesteps,
          .return_to_go = std::vector<float>(slots),
          .observations = std::vector<float>(slots * dataset.observation_size),
          .actions = std::vector<float>(slots * dataset.action_space.size()),
          .targets = std::vector<float>(slots * dataset.action_space.size()),
          .timesteps = std::vector<int64_t>(slots),
          .mask = std::vector<float>(slots),
          .weights = std::vector<float>(slots),
          .previous = std::vector<float>(static_cast<size_t>(count) * dataset.observation_size)};
}

// Fills clip number `clip` with the steps of `episode` from `begin` on, and with the labels of
// `delay` steps later. `returns_to_go` is [steps].
void FillClip(const Dataset& dataset, const Episode& episode,
              const std::vector<float>& returns_to_go, int begin, int delay, int clip,
              Clips* clips) {
  const size_t obs = dataset.observation_size;
  const size_t act = dataset.action_space.size();
  const auto observation = [&](int step) {
    return episode.observations.begin() + static_cast<int64_t>(step * obs);
  };
  std::copy_n(observation(std::max(0, begin - 1)), obs,
              clips->previous.begin() + static_cast<int64_t>(clip * obs));
  for (int i = 0; i < clips->timesteps_per_clip; ++i) {
    const size_t slot = static_cast<size_t>(clip) * clips->timesteps_per_clip + i;
    const int step = begin + i;
    clips->timesteps[slot] = std::max(0, step);
    if (step < 0 || step >= episode.steps()) continue;
    clips->mask[slot] = 1.0f;
    clips->return_to_go[slot] = returns_to_go[step];
    std::copy_n(observation(step), obs,
                clips->observations.begin() + static_cast<int64_t>(slot * obs));
    dataset.action_space.Encode(episode.actions[step],
                                absl::MakeSpan(clips->actions).subspan(slot * act, act));
    const int effect = step + delay;
    if (effect >= episode.steps()) continue;
    clips->weights[slot] = episode.weight(effect);
    dataset.action_space.Encode(episode.label(effect),
                                absl::MakeSpan(clips->targets).subspan(slot * act, act));
  }
}

}  // namespace

ClipPlaces::ClipPlaces(const std::vector<int>& lengths, const ClipShape& shape)
    : timesteps_(shape.timesteps), padding_(shape.padding) {
  SPIKESERVE_DCHECK(!lengths.empty());
  SPIKESERVE_DCHECK_GE(timesteps_, 1);
  int64_t steps = 0;
  for (const int length : lengths) {
    steps_before_.push_back(steps);
    steps += length;
  }
  steps_before_.push_back(steps);
}

ClipPlaces::Place ClipPlaces::Draw(uint64_t key, int clip) const {
  const uint64_t of_clip = RandomBits({key, static_cast<uint64_t>(clip)});
  const auto step = static_cast<int64_t>(
      Below(RandomBits({of_clip, kStep}), static_cast<uint64_t>(steps_before_.back())));
  const auto after = std::upper_bound(steps_before_.begin(), steps_before_.end(), step);
  const auto episode = static_cast<int>(after - steps_before_.begin()) - 1;
  const auto offset = static_cast<int64_t>(
      Below(RandomBits({of_clip, kOffset}), static_cast<uint64_t>(timesteps_)));
  const int64_t of_episode = step - steps_before_[episode];
  if (padding_ == Padding::kEnd) {
    return {.episode = episode,
            .begin = static_cast<int>(std::max<int64_t>(0, of_episode - offset))};
  }
  const int64_t steps = steps_before_[episode + 1] - steps_before_[episode];
  const int64_t end = std::min(steps, of_episode + offset + 1);
  return {.episode = episode, .begin = static_cast<int>(end - timesteps_)};
}

ClipSampler::ClipSampler(const Dataset& dataset, std::vector<int> episodes, const ClipShape& shape)
    : dataset_(dataset),
      episodes_(std::move(episodes)),
      shape_(shape),
      places_(LengthsOf(dataset, episodes_), shape) {
  for (const int index : episodes_) returns_to_go_.push_back(ReturnsToGo(dataset.episodes[index]));
}

Clips ClipSampler::Sample(uint64_t key, int count, double action_noise) const {
  Clips clips = EmptyClips(dataset_, count, shape_.timesteps);
  for (int clip = 0; clip < count; ++clip) {
    const ClipPlaces::Place place = places_.Draw(key, clip);
    FillClip(dataset_, dataset_.episodes[episodes_[place.episode]], returns_to_go_[place.episode],
             place.begin, DrawDelay(shape_.delay, key, clip), clip, &clips);
  }
  if (action_noise > 0.0) AddActionNoise(key, action_noise, &clips);
  return clips;
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

absl::StatusOr<Clips> ReadClips(const EpisodeSource& source, const std::vector<int>& episodes,
                                const ClipShape& shape, uint64_t key, int count) {
  std::vector<int> lengths;
  for (const int index : episodes) lengths.push_back(source.entries()[index].steps);
  const ClipPlaces places(lengths, shape);
  Clips clips = EmptyClips(source.dataset(), count, shape.timesteps);
  for (int clip = 0; clip < count; ++clip) {
    const ClipPlaces::Place place = places.Draw(key, clip);
    ASSIGN_OR_RETURN(const std::vector<Episode> read, source.Read({episodes[place.episode]}));
    const Episode& episode = read.front();
    FillClip(source.dataset(), episode, ReturnsToGo(episode), place.begin,
             DrawDelay(shape.delay, key, clip), clip, &clips);
  }
  return clips;
}

Split SplitEpisodes(const std::vector<EpisodeEntry>& entries, double fraction) {
  std::map<std::string, std::vector<int>> by_actor;
  for (size_t i = 0; i < entries.size(); ++i) {
    by_actor[entries[i].actor].push_back(static_cast<int>(i));
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
