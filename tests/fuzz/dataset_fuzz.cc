// Recorded episodes: every file is refused with a reason, or means the same when it is written and
// read again.
#include "core/dataset/dataset_cbor.h"
#include "tests/fuzz/fuzz_target.h"

namespace spikeserve {
namespace {

Dataset Discrete() {
  Episode episode = {
      .actor = "served",
      .seed = 3,
      .observations = {0.1f, -0.2f, 0.3f, 0.4f, 0.5f, 0.6f},
      .actions = {{.discrete = 1, .continuous = {}}, {.discrete = 0, .continuous = {}}},
      .rewards = {1.0, 0.5},
      .terminated = true};
  episode.served = ServedEpisode{.policy = "cartpole",
                                 .version = 2,
                                 .episode = 1,
                                 .target_return = 500.0,
                                 .seed = 7,
                                 .temperature = 1.0f,
                                 .learning = true,
                                 .labels = {{"robot", "seven"}},
                                 .answered_actions = episode.actions,
                                 .returns_to_go = {500.0f, 499.0f},
                                 .probabilities = {0.4f, 0.6f, 0.7f, 0.3f},
                                 .spikes = {10, 12}};
  return {.environment = "CartPole-v1",
          .observation_size = 2,
          .action_space = ActionSpace::Discrete(2),
          .recipe = {{"parts", {{{"minari", "cartpole/expert-v0"}}, {{"seed", 1}}}}},
          .episodes = {episode}};
}

Dataset Box() {
  Episode episode = {.actor = "expert",
                     .observations = {0.1f, 0.2f},
                     .actions = {{.discrete = 0, .continuous = {0.5f, -0.5f}}},
                     .labels = {{.discrete = 0, .continuous = {1.0f, -1.0f}}},
                     .weights = {0.5f},
                     .rewards = {-3.0},
                     .truncated = true,
                     .target_return = -100.0};
  return {.environment = "Pendulum-v1",
          .observation_size = 1,
          .action_space = ActionSpace::Box({-1.0f, -2.0f}, {1.0f, 2.0f}),
          .episodes = {episode}};
}

}  // namespace

void FuzzOne(absl::string_view input) {
  const auto dataset = ParseDataset(input);
  if (!dataset.ok()) {
    FUZZ_CHECK(!dataset.status().message().empty());
    return;
  }
  for (const Episode& episode : dataset->episodes) FUZZ_CHECK(CheckEpisode(*dataset, episode).ok());
  const std::string bytes = SerializeDataset(*dataset);
  const auto again = ParseDataset(bytes);
  FUZZ_CHECK(again.ok());
  FUZZ_CHECK(SerializeDataset(*again) == bytes);
  // Commands print the recipe.
  FUZZ_CHECK(!dataset->recipe.dump().empty());
}

std::vector<std::string> Seeds() { return {SerializeDataset(Discrete()), SerializeDataset(Box())}; }

}  // namespace spikeserve
