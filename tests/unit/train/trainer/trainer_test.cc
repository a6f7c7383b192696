#include "train/trainer/trainer.h"

#include <dlfcn.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <functional>
#include <utility>
#include <variant>

#include "absl/strings/str_cat.h"
#include "tests/support/small_policy.h"
#include "train/data/minari_writer.h"
#include "train/recording/record.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;

TrainOptions With(const std::function<void(TrainOptions&)>& change) {
  TrainOptions options;
  change(options);
  return options;
}

class TrainerTest : public testing::Test {
 protected:
  Policy Initial(const ModelConfig& config = SmallConfig()) const {
    Policy policy = SmallPolicy(config);
    const Moments moments = source_.statistics().observations();
    policy.weights.observation_mean.values = moments.mean;
    policy.weights.observation_std.values = moments.std;
    policy.return_offset = policy.return_scale = 250.0f;
    return policy;
  }

  const EpisodeSource source_{*RecordDataset({.steps = 2000})};
  const TrainOptions options_ = With([](TrainOptions& options) {
    options.iterations = 8;
    options.batch = 4;
    options.warmup = 2;
    options.action_noise = 0.1;
    options.rate_targets = {.hidden = 0.05, .readout = 0.1};
  });
};

std::vector<float> AllWeights(const Trainer& trainer) {
  Policy policy = trainer.CurrentPolicy();
  std::vector<float> all;
  for (const TensorSlot& slot : TensorSlots(policy.config, 4, 2, &policy.weights)) {
    std::visit([&](auto* t) { all.insert(all.end(), t->values.begin(), t->values.end()); },
               slot.tensor);
  }
  return all;
}

// Which libtorch does not tell how many it may have.
TEST_F(TrainerTest, ItsThreadsAreThoseOfTheLinearAlgebra) {
  const auto set = reinterpret_cast<void (*)(int)>(dlsym(RTLD_DEFAULT, "openblas_set_num_threads"));
  const auto get = reinterpret_cast<int (*)()>(dlsym(RTLD_DEFAULT, "openblas_get_num_threads"));
  if (set == nullptr || get == nullptr) GTEST_SKIP() << "libtorch has another library";
  set(2);
  const Trainer trainer(Initial(), source_, options_);
  EXPECT_EQ(get(), 1);
}

TEST_F(TrainerTest, ResumedRunEqualsTheUninterruptedOne) {
  const std::string path = testing::TempDir() + "/resume.pt";
  Trainer whole(Initial(), source_, options_);
  double mean_loss = 0.0, resumed_mean_loss = 1.0;
  const auto to_end = [](Trainer* trainer, double* mean) {
    while (!trainer->done()) {
      const auto step = trainer->Step();
      ASSERT_TRUE(step.ok());
      *mean = step->mean_loss;
    }
  };
  to_end(&whole, &mean_loss);

  Trainer first(Initial(), source_, options_);
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(first.Step().ok());
  ASSERT_TRUE(first.SaveCheckpoint(path).ok());
  Trainer second(Initial(), source_, options_);
  ASSERT_TRUE(second.LoadCheckpoint(path).ok());
  EXPECT_EQ(second.iteration(), 3);
  to_end(&second, &resumed_mean_loss);
  EXPECT_EQ(resumed_mean_loss, mean_loss);
  EXPECT_EQ(AllWeights(second), AllWeights(whole));
  EXPECT_NE(AllWeights(second), AllWeights(first));
}

// The running moments are part of a checkpoint. No other state of fading norms is.
TEST_F(TrainerTest, ARunWhoseNormsFadeEndsWithoutThemAndCanBeResumed) {
  const std::string path = testing::TempDir() + "/fade.pt";
  TrainOptions options = options_;
  options.norm = NormTraining::kFade;
  Trainer whole(Initial(), source_, options);
  while (!whole.done()) ASSERT_TRUE(whole.Step().ok());
  const Policy policy = whole.CurrentPolicy();
  EXPECT_EQ(policy.config.norm, NormKind::kNone);
  EXPECT_TRUE(policy.Validate().ok()) << policy.Validate();
  for (const int resumed_at : {3, 7}) {  // before and after the norms are gone
    Trainer first(Initial(), source_, options);
    for (int i = 0; i < resumed_at; ++i) ASSERT_TRUE(first.Step().ok());
    ASSERT_TRUE(first.SaveCheckpoint(path).ok());
    Trainer second(Initial(), source_, options);
    ASSERT_TRUE(second.LoadCheckpoint(path).ok());
    EXPECT_EQ(second.ValidationLoss(), first.ValidationLoss());
    while (!second.done()) ASSERT_TRUE(second.Step().ok());
    EXPECT_EQ(AllWeights(second), AllWeights(whole));
  }
  Trainer other(Initial(), source_, options_);
  EXPECT_THAT(std::string(other.LoadCheckpoint(path).message()), HasSubstr("--norm=fade"));
}

TEST_F(TrainerTest, APolicyWithoutNormsTrainsOn) {
  ModelConfig config = SmallConfig();
  config.norm = NormKind::kNone;
  Trainer trainer(Initial(config), source_, options_);
  const std::vector<float> before = AllWeights(trainer);
  while (!trainer.done()) ASSERT_TRUE(trainer.Step().ok());
  EXPECT_NE(AllWeights(trainer), before);
  EXPECT_EQ(trainer.CurrentPolicy().config.norm, NormKind::kNone);
}

// A constant rate does not know how long the training is; without penalties nothing else does.
TEST_F(TrainerTest, WithAConstantRateALongerRunBeginsAsAShortOne) {
  const auto weights_after_four = [&](Schedule schedule, int iterations) {
    TrainOptions options = options_;
    options.schedule = schedule;
    options.iterations = iterations;
    options.rate_targets = {};
    Trainer trainer(Initial(), source_, options);
    for (int i = 0; i < 4; ++i) EXPECT_TRUE(trainer.Step().ok());
    return AllWeights(trainer);
  };
  EXPECT_EQ(weights_after_four(Schedule::kConstant, 4), weights_after_four(Schedule::kConstant, 8));
  EXPECT_NE(weights_after_four(Schedule::kCosine, 4), weights_after_four(Schedule::kCosine, 8));
}

TEST_F(TrainerTest, CheckpointsOfAnotherRunAreRefused) {
  const std::string path = testing::TempDir() + "/other.pt";
  ASSERT_TRUE(Trainer(Initial(), source_, options_).SaveCheckpoint(path).ok());
  TrainOptions other = options_;
  other.batch = 5;
  EXPECT_THAT(std::string(Trainer(Initial(), source_, other).LoadCheckpoint(path).message()),
              testing::AllOf(HasSubstr(path), HasSubstr("batch=4"), HasSubstr("batch=5")));
  ModelConfig wide = SmallConfig();
  wide.ffn_size = 40;
  EXPECT_THAT(std::string(Trainer(Initial(wide), source_, options_).LoadCheckpoint(path).message()),
              testing::AllOf(HasSubstr("ffn_size=32"), HasSubstr("ffn_size=40")));
  ModelConfig fewer = SmallConfig();  // no tensor has another shape
  --fewer.ticks;
  EXPECT_THAT(
      std::string(Trainer(Initial(fewer), source_, options_).LoadCheckpoint(path).message()),
      HasSubstr(absl::StrCat("received ticks=", fewer.ticks)));
  Trainer sourced(Initial(), source_, options_, " data_sha256=abc");
  EXPECT_EQ(sourced.LoadCheckpoint(path).message(),
            path + ": to continue its run, expected none, received data_sha256=abc");
  EXPECT_EQ(sourced.iteration(), 0);
  std::ofstream(path) << "not a checkpoint";
  EXPECT_EQ(Trainer(Initial(), source_, options_).LoadCheckpoint(path).code(),
            absl::StatusCode::kFailedPrecondition);
}

// Trains on two datasets of Minari that take about 300 kB of memory.
class LargeDataTest : public TrainerTest {
 protected:
  static constexpr int64_t kSmallMemory = 64 * 1024;

  LargeDataTest() {
    const Dataset all = source_.dataset();
    Dataset first = all, second = all;
    const auto middle = static_cast<int64_t>(all.episodes.size() / 2);
    first.episodes.assign(all.episodes.begin(), all.episodes.begin() + middle);
    second.episodes.assign(all.episodes.begin() + middle, all.episodes.end());
    for (const auto& [dataset, path] :
         {std::pair(&first, paths_[0]), std::pair(&second, paths_[1])}) {
      std::filesystem::remove_all(path);
      EXPECT_TRUE(WriteMinariDataset(*dataset, path).ok());
    }
  }

  EpisodeSource Open(int64_t memory) const {
    absl::StatusOr<EpisodeSource> source = EpisodeSource::Open(paths_, memory);
    EXPECT_TRUE(source.ok()) << source.status();
    return *std::move(source);
  }

  static void TrainToEnd(Trainer* trainer) {
    while (!trainer->done()) {
      ASSERT_TRUE(trainer->ReadEpisodes().ok());
      ASSERT_TRUE(trainer->Step().ok());
    }
    ASSERT_TRUE(trainer->ReadEpisodes().ok());
  }

  const std::vector<std::string> paths_ = {testing::TempDir() + "/large-one-v0",
                                           testing::TempDir() + "/large-two-v0"};
};

TEST_F(LargeDataTest, DataThatFitTrainAsTheyDoInMemory) {
  const EpisodeSource opened = Open(int64_t{1} << 30);
  ASSERT_TRUE(opened.resident());
  Trainer from_files(Initial(), opened, options_);
  TrainToEnd(&from_files);
  Trainer from_memory(Initial(), source_, options_);
  while (!from_memory.done()) ASSERT_TRUE(from_memory.Step().ok());
  EXPECT_EQ(AllWeights(from_files), AllWeights(from_memory));
  EXPECT_EQ(from_files.ValidationLoss(), from_memory.ValidationLoss());
}

TEST_F(LargeDataTest, ChunksHoldTheEpisodesAndStatisticsOfTheFiles) {
  const EpisodeSource chunked = Open(kSmallMemory);
  ASSERT_FALSE(chunked.resident());
  EXPECT_TRUE(chunked.dataset().episodes.empty());
  EXPECT_EQ(chunked.statistics().observations().std, source_.statistics().observations().std);
  EXPECT_EQ(chunked.statistics().best_return(), source_.statistics().best_return());
  const std::vector<Episode>& all = source_.dataset().episodes;
  ASSERT_EQ(chunked.entries().size(), all.size());
  const auto last = static_cast<int>(all.size()) - 1;
  const absl::StatusOr<std::vector<Episode>> read = chunked.Read({last, 0, 1});
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_EQ((*read)[0].observations, all[last].observations);
  EXPECT_EQ((*read)[1].observations, all[0].observations);
  EXPECT_EQ((*read)[2].actions, all[1].actions);
  Trainer in_chunks(Initial(), chunked, options_), in_memory(Initial(), source_, options_);
  ASSERT_TRUE(in_chunks.ReadEpisodes().ok());
  EXPECT_EQ(in_chunks.ValidationLoss(), in_memory.ValidationLoss());
}

TEST_F(LargeDataTest, TrainingInChunksIsReproducibleAndCanBeResumed) {
  const std::string path = testing::TempDir() + "/chunks.pt";
  const EpisodeSource source = Open(kSmallMemory);
  TrainOptions options = options_;
  options.iterations = 40;  // more than one pass
  options.clip_steps = 20;
  Trainer whole(Initial(), source, options);
  TrainToEnd(&whole);

  Trainer first(Initial(), source, options);
  for (int i = 0; i < 23; ++i) {
    ASSERT_TRUE(first.ReadEpisodes().ok());
    ASSERT_TRUE(first.Step().ok());
  }
  ASSERT_TRUE(first.SaveCheckpoint(path).ok());
  Trainer second(Initial(), source, options);
  ASSERT_TRUE(second.LoadCheckpoint(path).ok());
  TrainToEnd(&second);
  EXPECT_EQ(AllWeights(second), AllWeights(whole));

  const EpisodeSource more_memory = Open(2 * kSmallMemory);
  EXPECT_THAT(std::string(Trainer(Initial(), more_memory, options).LoadCheckpoint(path).message()),
              testing::AllOf(HasSubstr("data_memory=65536"), HasSubstr("data_memory=131072")));
}

TEST_F(LargeDataTest, FilesThatCannotBeReadInPartsAreRefused) {
  const std::string whole = testing::TempDir() + "/large.cbor";
  ASSERT_TRUE(WriteDataset(source_.dataset(), whole).ok());
  EXPECT_TRUE(EpisodeSource::Open({whole}, int64_t{1} << 30).ok());
  const auto refused = EpisodeSource::Open({paths_[0], whole}, kSmallMemory);
  EXPECT_THAT(std::string(refused.status().message()),
              HasSubstr(whole + ": expected datasets of Minari"));
}

TEST_F(TrainerTest, DataOfOtherActionsAreRefused) {
  Dataset box = source_.dataset();
  box.action_space = ActionSpace::Box({-1.0f}, {1.0f});
  for (Episode& episode : box.episodes) {
    for (Action& action : episode.actions) action = {.discrete = 0, .continuous = {0.5f}};
  }
  const std::string discrete_path = testing::TempDir() + "/discrete.cbor";
  const std::string box_path = testing::TempDir() + "/box.cbor";
  ASSERT_TRUE(WriteDataset(source_.dataset(), discrete_path).ok());
  ASSERT_TRUE(WriteDataset(box, box_path).ok());
  for (const std::vector<std::string>& paths :
       {std::vector{box_path, discrete_path}, std::vector{discrete_path, box_path}}) {
    EXPECT_THAT(std::string(EpisodeSource::Open(paths, int64_t{1} << 30).status().message()),
                HasSubstr("expected equal spaces in all datasets of CartPole-v1"));
  }
}

TEST_F(TrainerTest, IntegerTrainingGivesTheRoundedPolicyOfItsFloats) {
  TrainOptions options = options_;
  options.arithmetic = Arithmetic::kInteger;
  const std::string path = testing::TempDir() + "/integer.pt";
  Trainer whole(Initial(), source_, options);
  EXPECT_EQ(whole.CurrentPolicy().config.arithmetic, Arithmetic::kInteger);
  while (!whole.done()) ASSERT_TRUE(whole.Step().ok());
  EXPECT_TRUE(whole.CurrentPolicy().Validate().ok());

  Trainer first(Initial(), source_, options);
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(first.Step().ok());
  ASSERT_TRUE(first.SaveCheckpoint(path).ok());
  Trainer second(Initial(), source_, options);
  ASSERT_TRUE(second.LoadCheckpoint(path).ok());
  EXPECT_EQ(AllWeights(second), AllWeights(first));
  while (!second.done()) ASSERT_TRUE(second.Step().ok());
  EXPECT_EQ(AllWeights(second), AllWeights(whole));
  EXPECT_NE(AllWeights(second), AllWeights(first));
}

TEST_F(TrainerTest, IntegerTrainingReportsWeightsThatCannotBeRounded) {
  TrainOptions options = options_;
  options.arithmetic = Arithmetic::kInteger;
  options.learning_rate = 1e36;  // after one step, sums leave the numbers of float32
  Trainer trainer(Initial(), source_, options);
  absl::Status status;
  while (status.ok() && !trainer.done()) status = trainer.Step().status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(status.message()), HasSubstr("tensor \""));
}

TEST_F(TrainerTest, FrozenTensorsKeepTheirValuesAndTheHeadLearnsLocally) {
  TrainOptions options = options_;
  options.frozen = {"head", "routing.hidden", "layers.0.coder"};
  const Policy initial = Initial();
  const auto changed = [&](const TrainOptions& with) {
    Trainer trainer(initial, source_, with);
    while (!trainer.done()) EXPECT_TRUE(trainer.Step().ok());
    std::vector<std::string> names;
    const auto before = CopyTensors(initial), after = CopyTensors(trainer.CurrentPolicy());
    for (const auto& [name, tensor] : before) {
      if (!torch::equal(tensor, after.at(name))) names.push_back(name);
    }
    return names;
  };
  const std::vector<std::string> frozen = changed(options);
  EXPECT_THAT(frozen, testing::Contains("layers.0.routing.gate.weight"));
  EXPECT_THAT(frozen, testing::Contains("layers.0.ffn.coder.gain"));
  EXPECT_THAT(
      frozen,
      testing::Not(testing::Contains(testing::AnyOf(HasSubstr("head."), HasSubstr("routing.hidden"),
                                                    testing::StartsWith("layers.0.coder")))));
  options.plasticity.rate = 0.01;
  EXPECT_THAT(changed(options), testing::Contains("head.weight"));

  EXPECT_TRUE(CheckFrozen(options.frozen, initial).ok());
  EXPECT_THAT(CheckFrozen({"heads"}, initial).message(),
              testing::AllOf(HasSubstr("--freeze: "), HasSubstr("received heads")));
}

class TrainerModeTest : public TrainerTest, public testing::WithParamInterface<Mode> {};

TEST_P(TrainerModeTest, LearnsToImitate) {
  const EpisodeSource experts(*RecordDataset({.seed = 0, .steps = 2000, .expert_fraction = 1.0}));
  TrainOptions options = With([](TrainOptions& o) {
    o.iterations = 100;
    o.batch = 8;
    o.learning_rate = 5e-3;
    o.warmup = 10;
  });
  for (const Arithmetic arithmetic : {Arithmetic::kFloat32, Arithmetic::kInteger}) {
    if (GetParam() == Mode::kDense && arithmetic != Arithmetic::kFloat32) continue;
    options.arithmetic = arithmetic;
    Trainer trainer(Initial(SmallConfig(GetParam())), experts, options);
    ASSERT_TRUE(trainer.has_validation());
    const double before = trainer.ValidationLoss();
    while (!trainer.done()) ASSERT_TRUE(trainer.Step().ok());
    EXPECT_LT(trainer.ValidationLoss(), 0.75 * before) << ToString(arithmetic);
    EXPECT_TRUE(trainer.CurrentPolicy().Validate().ok());
  }
}

INSTANTIATE_TEST_SUITE_P(Modes, TrainerModeTest,
                         testing::Values(Mode::kFull, Mode::kPos, Mode::kRoute, Mode::kBaseline,
                                         Mode::kDense),
                         [](const auto& test) { return std::string(ToString(test.param)); });

TEST(PatchTest, TheExportedEmbeddingIsTheProductOfTheTrainedMaps) {
  const PatchShape shape = {.height = 4, .width = 6, .channels = 2, .size = 2, .features = 3};
  const PatchMaps maps = RandomPatchMaps(shape, /*hidden_size=*/5, /*seed=*/1);
  const torch::Tensor image = torch::arange(48, torch::kFloat).view({4, 6, 2});
  std::vector<torch::Tensor> features;
  for (int row = 0; row < 4; row += 2) {
    for (int column = 0; column < 6; column += 2) {
      const torch::Tensor patch = image.slice(0, row, row + 2).slice(1, column, column + 2);
      features.push_back(torch::mv(maps.embedding, patch.flatten()));
    }
  }
  const torch::Tensor expected = torch::mv(maps.mix, torch::cat(features));
  const torch::Tensor folded = FoldPatches(shape, maps);
  ASSERT_EQ(folded.sizes(), (std::vector<int64_t>{5, 48}));
  EXPECT_TRUE(torch::allclose(torch::mv(folded, image.flatten()), expected, 1e-4, 1e-4));
}

TEST(PatchTest, ShapesThatDoNotFitAreNamed) {
  const PatchShape shape = {.height = 16, .width = 12, .channels = 3, .size = 4, .features = 8};
  EXPECT_TRUE(shape.Validate(16 * 12 * 3).ok());
  EXPECT_EQ(shape.Validate(100).message(),
            "--image_shape: expected HEIGHT,WIDTH,CHANNELS of the 100 numbers of an observation, "
            "received 16,12,3");
  PatchShape other = shape;
  other.size = 8;
  EXPECT_EQ(other.Validate(16 * 12 * 3).message(),
            "--patch_size: expected a divisor of height 16 and width 12, received 8");
}

TEST(TrainOptionsTest, BadOptionsAreNamed) {
  EXPECT_TRUE(TrainOptions{}.Validate().ok());
  EXPECT_EQ(With([](TrainOptions& o) { o.batch = 0; }).Validate().message(),
            "batch: expected at least 1, received 0");
  EXPECT_EQ(With([](TrainOptions& o) { o.action_noise = 2.0; }).Validate().message(),
            "action_noise: expected 0 to 1, received 2");
  EXPECT_EQ(With([](TrainOptions& o) { o.rate_targets.hidden = -0.01; }).Validate().message(),
            "target_rate: expected 0 to 100 percent, received -1");
  EXPECT_EQ(With([](TrainOptions& o) { o.threads = 0; }).Validate().message(),
            "threads: expected at least 1, received 0");
  EXPECT_EQ(With([](TrainOptions& o) { o.plasticity.trace_decay = 2.0; }).Validate().message(),
            "trace_decay: expected 0 to 1, received 2");
  EXPECT_EQ(With([](TrainOptions& o) {
              o.norm = NormTraining::kFade;
              o.arithmetic = Arithmetic::kInteger;
            })
                .Validate()
                .message(),
            "norm: expected layer with arithmetic integer, received fade");
}

}  // namespace
}  // namespace spikeserve
