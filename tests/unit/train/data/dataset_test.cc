// Tests of offline data: recording, files, clips and the split into training and validation.

#include "train/data/dataset.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <numeric>
#include <set>

#include "tests/support/small_policy.h"
#include "train/data/chunk_plan.h"
#include "train/data/clip_sampler.h"
#include "train/recording/record.h"

namespace spikeserve {
namespace {

using testing::Each;
using testing::ElementsAre;
using testing::HasSubstr;
using testing::UnorderedElementsAreArray;

// Returns an episode of `steps` steps whose observation at step t is {t} and whose rewards are 1.
Episode Counting(int steps) {
  Episode episode = {.actor = "expert",
                     .seed = 1,
                     .observations = {},
                     .actions = {},
                     .rewards = std::vector<double>(steps, 1.0),
                     .terminated = true,
                     .truncated = false};
  for (int t = 0; t <= steps; ++t) episode.observations.push_back(static_cast<float>(t));
  for (int t = 0; t < steps; ++t) {
    episode.actions.push_back({.discrete = t % 2, .continuous = {}});
  }
  return episode;
}

Dataset DatasetOf(std::vector<Episode> episodes) {
  return {.environment = "CartPole-v1",
          .observation_size = 1,
          .action_space = ActionSpace::Discrete(2),
          .recipe = {},
          .episodes = std::move(episodes)};
}

std::string TemporaryFile(const std::string& name) {
  return (std::filesystem::path(testing::TempDir()) / name).string();
}

TEST(DatasetTest, ChangesAreScaledByTheirRootMeanSquareWithinEpisodes) {
  Episode episode = Counting(4);
  episode.observations = {0.0f, 3.0f, 2.0f, 2.0f, 90.0f};  // the last one is no input
  DataStatistics statistics(1);
  statistics.Add(episode);
  EXPECT_THAT(statistics.change_std(), ElementsAre(std::sqrt(10.0f / 3.0f)));
  statistics.Add(episode);  // from the end of one episode to the start of the next nothing changes
  EXPECT_THAT(statistics.change_std(), ElementsAre(std::sqrt(10.0f / 3.0f)));
  episode.observations.assign(5, 1.0e6f);
  DataStatistics constant(1);
  constant.Add(episode);
  EXPECT_THAT(constant.change_std(), ElementsAre(1.0f));
}

TEST(DatasetTest, LabelsOfABoxHaveMoments) {
  Episode episode = Counting(2);
  episode.actions = {{.continuous = {7.0f, 7.0f}}, {.continuous = {7.0f, 7.0f}}};
  episode.labels = {{.continuous = {1.0f, 5.0f}}, {.continuous = {3.0f, 5.0f}}};
  DataStatistics statistics(1);
  statistics.Add(episode);
  EXPECT_THAT(statistics.labels().mean, ElementsAre(2.0f, 5.0f));
  EXPECT_THAT(statistics.labels().std, ElementsAre(testing::FloatNear(1.0f, 1e-5f), 1.0f));
  DataStatistics discrete(1);
  discrete.Add(Counting(3));
  EXPECT_TRUE(discrete.labels().mean.empty());
}

TEST(DatasetTest, ClipsKnowTheObservationBeforeThem) {
  const Dataset dataset = DatasetOf({Counting(9)});
  const Clips clips =
      ClipSampler(dataset, {0}, {.timesteps = 3}).Sample(/*key=*/1, /*count=*/40, 0.0);
  for (int clip = 0; clip < clips.count; ++clip) {
    const float first = clips.observations[static_cast<size_t>(clip) * 3];
    EXPECT_EQ(clips.previous[clip], std::max(0.0f, first - 1.0f));
  }
  EXPECT_THAT(clips.previous, testing::Contains(testing::Gt(2.0f)));
}

TEST(DatasetTest, ReturnsToGoAreSumsOfTheRewardsAhead) {
  Episode episode = Counting(3);
  episode.rewards = {1.0, -2.0, 5.0};
  EXPECT_THAT(ReturnsToGo(episode), ElementsAre(4.0f, 3.0f, 5.0f));
  episode.target_return = 10.0;
  EXPECT_THAT(ReturnsToGo(episode), ElementsAre(10.0f, 9.0f, 11.0f));
}

TEST(DatasetTest, MomentsAreOfTheStepsAlone) {
  DataStatistics statistics(1);
  statistics.Add(Counting(3));  // 0, 1, 2
  const Moments moments = statistics.observations();
  EXPECT_FLOAT_EQ(moments.mean[0], 1.0f);
  EXPECT_NEAR(moments.std[0], 0.8165, 1e-4);
}

TEST(DatasetTest, TheDeviationOfAConstantIsOne) {
  Episode episode = Counting(3);
  episode.observations.clear();
  // A large constant, whose variance is not 0 in floating-point numbers, and a small change.
  for (const float x : {0.0F, 1e-3F, 0.0F, 1e-3F}) {
    episode.observations.push_back(12345.678F);
    episode.observations.push_back(x);
  }
  DataStatistics statistics(2);
  statistics.Add(episode);
  const Moments moments = statistics.observations();
  EXPECT_EQ(moments.std[0], 1.0F);
  EXPECT_NEAR(moments.std[1], 4.7e-4F, 1e-5F);
}

TEST(DatasetTest, PooledMomentsAreOfAllPixelsOfAChannel) {
  Episode episode = Counting(2);
  // Two pixels of two channels, at three times; the last observation is not a step.
  episode.observations = {1, 10, 3, 10, 5, 20, 7, 20, 100, 100, 100, 100};
  DataStatistics statistics(4);
  statistics.Add(episode);
  const Moments moments = statistics.PooledMoments(2);
  EXPECT_THAT(moments.mean, ElementsAre(4.0f, 15.0f, 4.0f, 15.0f));
  EXPECT_NEAR(moments.std[0], std::sqrt(5.0), 1e-4);
  EXPECT_NEAR(moments.std[1], 5.0, 1e-4);
  EXPECT_EQ(moments.std[0], moments.std[2]);
  EXPECT_THAT(statistics.observations().mean, ElementsAre(3.0f, 15.0f, 5.0f, 15.0f));
}

TEST(DatasetTest, FileRoundTrips) {
  const std::string path = TemporaryFile("dataset_round_trip.cbor");
  const Dataset written = *RecordDataset({.steps = 300, .disturbed_fraction = 0.3});
  ASSERT_TRUE(WriteDataset(written, path).ok());
  const absl::StatusOr<Dataset> read = ReadDataset(path);
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_EQ(read->environment, written.environment);
  EXPECT_EQ(read->action_space, written.action_space);
  EXPECT_EQ(read->recipe, written.recipe);
  ASSERT_EQ(read->episodes.size(), written.episodes.size());
  for (size_t i = 0; i < written.episodes.size(); ++i) {
    EXPECT_EQ(read->episodes[i].observations, written.episodes[i].observations);
    EXPECT_EQ(read->episodes[i].actions, written.episodes[i].actions);
    EXPECT_EQ(read->episodes[i].labels, written.episodes[i].labels);
    EXPECT_EQ(read->episodes[i].rewards, written.episodes[i].rewards);
    EXPECT_EQ(read->episodes[i].seed, written.episodes[i].seed);
  }
}

TEST(DatasetTest, BrokenFilesAreRefusedWithPathAndReason) {
  const std::string path = TemporaryFile("broken.cbor");
  std::ofstream(path) << "not CBOR";
  EXPECT_THAT(std::string(ReadDataset(path).status().message()),
              testing::AllOf(HasSubstr(path), HasSubstr("expected a dataset in CBOR")));
  Dataset dataset = DatasetOf({Counting(3)});
  dataset.episodes[0].rewards.pop_back();
  ASSERT_TRUE(WriteDataset(dataset, path).ok());
  EXPECT_THAT(std::string(ReadDataset(path).status().message()),
              HasSubstr("episode 0: rewards: expected 3, received 2"));
  EXPECT_EQ(ReadDataset(path + ".none").status().code(), absl::StatusCode::kNotFound);
}

TEST(RecordTest, HalfTheStepsAreTheExpertsAndNoSeedIsForEvaluation) {
  const Dataset dataset = *RecordDataset({.steps = 4000});
  int expert = 0, random = 0;
  std::set<uint64_t> seeds;
  for (const Episode& episode : dataset.episodes) {
    (episode.actor == "expert" ? expert : random) += episode.steps();
    EXPECT_EQ(episode.truncated, episode.actor == "expert");
    EXPECT_LT(episode.seed, kFirstEvaluationSeed);
    EXPECT_NE(episode.terminated, episode.truncated);
    seeds.insert(episode.seed);
  }
  EXPECT_EQ(expert, 2000);
  EXPECT_GE(random, 2000);
  EXPECT_GT(seeds.size(), dataset.episodes.size() * 9 / 10);
}

TEST(RecordTest, BadOptionsAreNamed) {
  EXPECT_EQ(RecordDataset({.steps = 0}).status().message(),
            "steps: expected at least 1, received 0");
  EXPECT_EQ(RecordDataset({.expert_fraction = 1.5}).status().message(),
            "expert_fraction: expected 0 to 1, received 1.5");
  EXPECT_EQ(RecordDataset({.disturbed_fraction = 0.6}).status().message(),
            "disturbed_fraction: expected 0 to 0.5, received 0.6");
  EXPECT_EQ(RecordDataset({.longest_burst = 0}).status().message(),
            "longest_burst: expected at least 1, received 0");
  EXPECT_EQ(RecordDataset({.wide_start_fraction = 0.5}).status().message(),
            "wide_start_fraction: expected 0 for CartPole-v1, received 0.5");
}

TEST(RecordTest, DisturbedEpisodesAreLabelledByTheExpert) {
  const Dataset dataset =
      *RecordDataset({.steps = 3000, .expert_fraction = 0.0, .disturbed_fraction = 1.0});
  const std::unique_ptr<Expert> expert = *MakeExpert({});
  int steps = 0, disturbed = 0, longest = 0;
  for (const Episode& episode : dataset.episodes) {
    ASSERT_EQ(episode.actor, "disturbed");
    ASSERT_EQ(episode.labels.size(), episode.actions.size());
    int run = 0;
    for (int t = 0; t < episode.steps(); ++t, ++steps) {
      const auto observation = episode.observations.begin() + 4 * t;
      const std::vector<double> state(observation, observation + 4);
      ASSERT_EQ(episode.labels[t], expert->Act(state));
      const bool differs = episode.actions[t] != episode.labels[t];
      disturbed += differs;
      longest = std::max(longest, run = differs ? run + 1 : 0);
    }
  }
  // The average rate is 0.15 and the average burst 4.5 steps; half of the random actions equal the
  // expert's by chance.
  EXPECT_GT(disturbed, steps / 10);
  EXPECT_LT(disturbed, steps / 3);
  EXPECT_GT(longest, 2);
}

TEST(RecordTest, AStudentActsAndTheExpertLabels) {
  const auto student = std::make_shared<const Policy>(SmallPolicy());
  const Dataset dataset =
      *RecordDataset({.steps = 200, .expert_fraction = 0.0, .student = student, .weigh = true});
  const std::unique_ptr<Expert> expert = *MakeExpert({});
  int differ = 0;
  for (const Episode& episode : dataset.episodes) {
    ASSERT_EQ(episode.actor, "student");
    EXPECT_THAT(episode.weights, Each(1.0f));  // this expert's StateImportance() are always 1
    for (int t = 0; t < episode.steps(); ++t) {
      const auto observation = episode.observations.begin() + 4 * t;
      ASSERT_EQ(episode.labels[t], expert->Act(std::vector<double>(observation, observation + 4)));
      differ += episode.labels[t] != episode.actions[t];
    }
  }
  EXPECT_GT(differ, 20);
  EXPECT_EQ(RecordDataset({.expert = {.environment = "Acrobot-v1"}, .student = student})
                .status()
                .message(),
            "policy: expected the observations and actions of Acrobot-v1");
}

TEST(DatasetTest, PartsAreOfOneEnvironment) {
  const Dataset all = *Concatenate({DatasetOf({Counting(2)}), DatasetOf({Counting(3)})});
  EXPECT_EQ(all.episodes.size(), 2u);
  EXPECT_EQ(all.recipe["parts"].size(), 2u);
  Dataset other = DatasetOf({Counting(2)});
  other.environment = "Acrobot-v1";
  EXPECT_EQ(Concatenate({DatasetOf({Counting(2)}), other}).status().message(),
            "data: expected all of CartPole-v1, received one of Acrobot-v1");
}

TEST(ClipSamplerTest, WeightsAreOfTheSteps) {
  Episode episode = Counting(3);
  episode.weights = {0.5f, 1.0f, 2.0f};
  const Dataset dataset = DatasetOf({episode});
  const Clips clips =
      ClipSampler(dataset, {0}, {.timesteps = 2}).Sample(/*key=*/1, /*count=*/20, 0.0);
  for (size_t slot = 0; slot < clips.mask.size(); ++slot) {
    const int64_t t = clips.timesteps[slot];
    EXPECT_EQ(clips.weights[slot], t < 3 ? episode.weights[t] : 0.0f);
  }
}

// The last steps of a clip are those of the episode, and what is missing before them is 0.
TEST(ClipSamplerTest, FrontPaddingIsBeforeTheFirstStep) {
  const Dataset dataset = DatasetOf({Counting(3)});
  constexpr int kClip = 5;
  const Clips clips = ClipSampler(dataset, {0}, {.timesteps = kClip, .padding = Padding::kFront})
                          .Sample(/*key=*/1, /*count=*/200, 0.0);
  std::vector<bool> seen(kClip);
  for (int clip = 0; clip < clips.count; ++clip) {
    const auto mask = absl::MakeSpan(clips.mask).subspan(size_t{kClip} * clip, kClip);
    const auto padded = std::find(mask.begin(), mask.end(), 1.0f) - mask.begin();
    ASSERT_LT(padded, kClip);
    seen[padded] = true;
    for (int i = 0; i < kClip; ++i) {
      const size_t slot = size_t{kClip} * clip + i;
      const bool in_episode = i >= padded;
      ASSERT_EQ(mask[i], in_episode ? 1.0f : 0.0f);
      ASSERT_EQ(clips.weights[slot], mask[i]);
      ASSERT_EQ(clips.timesteps[slot], in_episode ? i - padded : 0);
      ASSERT_EQ(clips.observations[slot], static_cast<float>(clips.timesteps[slot]));
      ASSERT_EQ(clips.targets[2 * slot] + clips.targets[2 * slot + 1], mask[i]);
    }
    ASSERT_EQ(clips.previous[clip], 0.0f);
  }
  EXPECT_THAT(seen, ElementsAre(false, false, true, true, true));
}

// Step t is decided at its observation and executed two steps later, where the label is.
TEST(ClipSamplerTest, WithADelayTheTargetIsTheLabelOfTheStepThatIsExecuted) {
  Episode episode = Counting(5);  // executes 0, 1, 0, 1, 0
  const std::vector<int> labels = {0, 0, 1, 1, 0};
  for (const int label : labels) episode.labels.push_back({.discrete = label, .continuous = {}});
  episode.weights = {1.0f, 2.0f, 3.0f, 4.0f, 5.0f};
  const Dataset dataset = DatasetOf({episode});
  const std::vector<float> weights = {3.0f, 4.0f, 5.0f, 0.0f, 0.0f};
  const std::vector<float> targets = {1.0f, 1.0f, 0.0f, 0.0f, 0.0f};  // of action 1
  const Clips clips = ClipSampler(dataset, {0}, {.timesteps = 3, .delay = {.least = 2, .most = 2}})
                          .Sample(1, 20, 0.0);
  for (size_t slot = 0; slot < clips.mask.size(); ++slot) {
    const int64_t t = clips.timesteps[slot];
    ASSERT_EQ(clips.mask[slot], t < 5 ? 1.0f : 0.0f);
    if (t >= 5) continue;
    ASSERT_EQ(clips.weights[slot], weights[t]);
    ASSERT_EQ(clips.targets[2 * slot + 1], targets[t]);
    ASSERT_EQ(clips.targets[2 * slot], t < 3 ? 1.0f - targets[t] : 0.0f);
    ASSERT_EQ(clips.actions[2 * slot + 1], static_cast<float>(t % 2));  // the executed one
  }
}

TEST(ClipSamplerTest, EveryClipDrawsADelayOfItsOwn) {
  const Dataset dataset = DatasetOf({Counting(40)});
  constexpr int kClip = 4, kCount = 400;
  const Clips clips =
      ClipSampler(dataset, {0}, {.timesteps = kClip, .delay = {.least = 1, .most = 3}})
          .Sample(/*key=*/1, kCount, /*action_noise=*/0.0);
  int same = 0, other = 0;  // clips far from the end, by whether the label is the executed action
  for (int clip = 0; clip < kCount; ++clip) {
    const auto first = static_cast<size_t>(clip) * kClip;
    if (clips.timesteps[first] > 30) continue;
    const bool differs = clips.targets[2 * first] != clips.actions[2 * first];
    ++(differs ? other : same);
    for (size_t i = 1; i < kClip; ++i) {  // one delay in all of a clip
      ASSERT_EQ(clips.targets[2 * (first + i)] != clips.actions[2 * (first + i)], differs);
    }
  }
  EXPECT_NEAR(static_cast<double>(other) / (other + same), 2.0 / 3.0, 0.1);  // 1, 3 of 1, 2, 3
}

TEST(RecordTest, AQuarterOfPendulumsStartsAreWide) {
  const Dataset dataset = *RecordDataset({.expert = {.environment = "Pendulum-v1", .coarsening = 8},
                                          .steps = 20000,
                                          .expert_fraction = 0.0,
                                          .disturbed_fraction = 1.0,
                                          .wide_start_fraction = 0.25});
  ASSERT_EQ(dataset.episodes.size(), 100u);
  int fast = 0;
  for (const Episode& episode : dataset.episodes) fast += std::abs(episode.observations[2]) > 1.0f;
  EXPECT_NEAR(fast, 25 * 7 / 8, 10);
}

TEST(ClipSamplerTest, LabelsAreTheTargetsAndActionsTheTokens) {
  Episode episode = Counting(2);
  episode.labels = {episode.actions[1], episode.actions[1]};
  const Dataset dataset = DatasetOf({episode});
  const Clips clips =
      ClipSampler(dataset, {0}, {.timesteps = 1}).Sample(/*key=*/1, /*count=*/20, 0.0);
  for (int clip = 0; clip < clips.count; ++clip) {
    EXPECT_EQ(clips.targets[2 * clip + 1], 1.0f);
    EXPECT_EQ(clips.actions[2 * clip + 1], static_cast<float>(clips.timesteps[clip]));
  }
}

TEST(ClipSamplerTest, ClipsEndWithTheirEpisodeAndTheRestIsMasked) {
  constexpr int kSteps = 7, kClip = 5;
  const Dataset dataset = DatasetOf({Counting(kSteps)});
  const Clips clips =
      ClipSampler(dataset, {0}, {.timesteps = kClip}).Sample(/*key=*/1, /*count=*/200, 0.0);
  std::set<int64_t> begins;
  for (int clip = 0; clip < clips.count; ++clip) {
    begins.insert(clips.timesteps[clip * kClip]);
    for (int i = 0; i < kClip; ++i) {
      const int slot = clip * kClip + i;
      const int64_t t = clips.timesteps[clip * kClip] + i;
      const bool inside = t < kSteps;
      ASSERT_EQ(clips.timesteps[slot], t);
      ASSERT_EQ(clips.mask[slot], inside ? 1.0f : 0.0f);
      ASSERT_EQ(clips.observations[slot], inside ? static_cast<float>(t) : 0.0f);
      ASSERT_EQ(clips.return_to_go[slot], inside ? static_cast<float>(kSteps - t) : 0.0f);
      ASSERT_EQ(clips.targets[2 * slot + 1], inside && t % 2 == 1 ? 1.0f : 0.0f);
    }
  }
  EXPECT_EQ(begins, (std::set<int64_t>{0, 1, 2, 3, 4, 5, 6}));
}

TEST(ClipSamplerTest, ActionNoiseChangesTokensAndNotTargets) {
  const Dataset dataset = DatasetOf({Counting(400)});
  const ClipSampler sampler(dataset, {0}, {.timesteps = 20});
  const Clips clean = sampler.Sample(3, 50, 0.0), noisy = sampler.Sample(3, 50, 0.4);
  EXPECT_EQ(clean.actions, clean.targets);
  EXPECT_EQ(noisy.targets, clean.targets);
  int changed = 0, steps = 0;
  for (size_t slot = 0; slot < clean.mask.size(); ++slot) {
    steps += clean.mask[slot] > 0.0f;
    changed += noisy.actions[2 * slot] != clean.actions[2 * slot];
    ASSERT_EQ(noisy.actions[2 * slot] + noisy.actions[2 * slot + 1], clean.mask[slot]);
  }
  // Half of the random actions equal the original ones.
  EXPECT_NEAR(static_cast<double>(changed) / steps, 0.4 / 2.0, 0.05);
}

// Returns entries of 1 to `count` steps, each of which takes a kilobyte for each step.
std::vector<EpisodeEntry> Entries(int count) {
  std::vector<EpisodeEntry> entries;
  for (int i = 0; i < count; ++i) {
    entries.push_back({.index = i, .steps = i + 1, .memory = 1024 * (i + 1), .actor = "expert"});
  }
  return entries;
}

std::vector<int> UpTo(int count) {
  std::vector<int> numbers(count);
  std::iota(numbers.begin(), numbers.end(), 0);
  return numbers;
}

TEST(ChunkPlanTest, EveryPassUsesEveryEpisodeOnceWithinTheMemory) {
  const std::vector<EpisodeEntry> entries = Entries(20);  // 210 steps
  ChunkPlan plan(entries, UpTo(20), {.memory = 50 * 1024, .steps_per_iteration = 10, .seed = 1});
  std::vector<std::vector<int>> passes;
  int64_t iteration = 0;
  for (int pass = 0; pass < 3; ++pass) {
    std::vector<int>& used = passes.emplace_back();
    while (used.size() < entries.size()) {
      const ChunkPlan::Chunk chunk = plan.At(iteration);
      int steps = 0;
      for (const int i : chunk.episodes) steps += entries[i].steps;
      EXPECT_LE(steps, 50);
      EXPECT_EQ(chunk.begin, iteration);
      EXPECT_EQ(chunk.end, iteration + (steps + 9) / 10);
      used.insert(used.end(), chunk.episodes.begin(), chunk.episodes.end());
      iteration = chunk.end;
    }
    EXPECT_THAT(used, UnorderedElementsAreArray(UpTo(20)));
  }
  EXPECT_NE(passes[0], passes[1]);
  EXPECT_NE(passes[1], passes[2]);
}

TEST(ChunkPlanTest, ThePlanOfAnIterationDoesNotDependOnTheOneBefore) {
  const std::vector<EpisodeEntry> entries = Entries(20);
  const ChunkPlan::Options options = {.memory = 30 * 1024, .steps_per_iteration = 7, .seed = 2};
  ChunkPlan forward(entries, UpTo(20), options);
  std::vector<std::vector<int>> chunks;
  for (int i = 0; i < 100; ++i) chunks.push_back(forward.At(i).episodes);
  for (const int i : {99, 3, 50, 0}) {
    EXPECT_EQ(ChunkPlan(entries, UpTo(20), options).At(i).episodes, chunks[i]) << i;
    EXPECT_EQ(forward.At(i).episodes, chunks[i]) << i;
  }
}

TEST(ChunkPlanTest, AnEpisodeLargerThanTheMemoryIsAChunkAlone) {
  const std::vector<EpisodeEntry> entries = Entries(3);
  ChunkPlan plan(entries, UpTo(3), {.memory = 1, .steps_per_iteration = 100, .seed = 3});
  for (int i = 0; i < 6; ++i) EXPECT_EQ(plan.At(i).episodes.size(), 1u);
}

TEST(SplitTest, HoldsOutTheLastEpisodesOfEveryActor) {
  std::vector<EpisodeEntry> entries(5, {.steps = 3, .actor = "expert"});
  entries[0].actor = entries[3].actor = "random";
  const Split split = SplitEpisodes(entries, 0.1);
  EXPECT_THAT(split.training, ElementsAre(1, 2, 0));
  EXPECT_THAT(split.validation, ElementsAre(4, 3));
  EXPECT_TRUE(SplitEpisodes({entries[0]}, 0.5).validation.empty());
}

}  // namespace
}  // namespace spikeserve
