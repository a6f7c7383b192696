#include "train/trainer/trainer.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <functional>
#include <variant>

#include "tests/support/small_policy.h"
#include "train/data/record.h"

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
    const Moments moments = ObservationMoments(dataset_);
    policy.weights.observation_mean.values = moments.mean;
    policy.weights.observation_std.values = moments.std;
    policy.return_offset = policy.return_scale = 250.0f;
    return policy;
  }

  const Dataset dataset_ = *RecordDataset({.steps = 2000});
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

TEST_F(TrainerTest, ResumedRunEqualsTheUninterruptedOne) {
  const std::string path = testing::TempDir() + "/resume.pt";
  Trainer whole(Initial(), dataset_, options_);
  while (!whole.done()) ASSERT_TRUE(whole.Step().ok());

  Trainer first(Initial(), dataset_, options_);
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(first.Step().ok());
  ASSERT_TRUE(first.SaveCheckpoint(path).ok());
  Trainer second(Initial(), dataset_, options_);
  ASSERT_TRUE(second.LoadCheckpoint(path).ok());
  EXPECT_EQ(second.iteration(), 3);
  while (!second.done()) ASSERT_TRUE(second.Step().ok());
  EXPECT_EQ(AllWeights(second), AllWeights(whole));
  EXPECT_NE(AllWeights(second), AllWeights(first));
}

TEST_F(TrainerTest, CheckpointsOfAnotherRunAreRefused) {
  const std::string path = testing::TempDir() + "/other.pt";
  ASSERT_TRUE(Trainer(Initial(), dataset_, options_).SaveCheckpoint(path).ok());
  TrainOptions other = options_;
  other.batch = 5;
  EXPECT_THAT(std::string(Trainer(Initial(), dataset_, other).LoadCheckpoint(path).message()),
              testing::AllOf(HasSubstr(path), HasSubstr("batch=4"), HasSubstr("batch=5")));
  ModelConfig wide = SmallConfig();
  wide.ffn_size = 40;
  EXPECT_THAT(
      std::string(Trainer(Initial(wide), dataset_, options_).LoadCheckpoint(path).message()),
      HasSubstr("has another shape"));
  std::ofstream(path) << "not a checkpoint";
  EXPECT_EQ(Trainer(Initial(), dataset_, options_).LoadCheckpoint(path).code(),
            absl::StatusCode::kFailedPrecondition);
}

TEST_F(TrainerTest, IntegerTrainingGivesTheRoundedPolicyOfItsFloats) {
  TrainOptions options = options_;
  options.arithmetic = Arithmetic::kInt8;
  const std::string path = testing::TempDir() + "/integer.pt";
  Trainer whole(Initial(), dataset_, options);
  EXPECT_EQ(whole.CurrentPolicy().config.arithmetic, Arithmetic::kInt8);
  while (!whole.done()) ASSERT_TRUE(whole.Step().ok());
  EXPECT_TRUE(whole.CurrentPolicy().Validate().ok());

  Trainer first(Initial(), dataset_, options);
  for (int i = 0; i < 3; ++i) ASSERT_TRUE(first.Step().ok());
  ASSERT_TRUE(first.SaveCheckpoint(path).ok());
  Trainer second(Initial(), dataset_, options);
  ASSERT_TRUE(second.LoadCheckpoint(path).ok());
  EXPECT_EQ(AllWeights(second), AllWeights(first));
  while (!second.done()) ASSERT_TRUE(second.Step().ok());
  EXPECT_EQ(AllWeights(second), AllWeights(whole));
  EXPECT_NE(AllWeights(second), AllWeights(first));
}

TEST_F(TrainerTest, IntegerTrainingReportsWeightsThatCannotBeRounded) {
  TrainOptions options = options_;
  options.arithmetic = Arithmetic::kInt8;
  options.learning_rate = 1e36;  // after one step, sums leave the numbers of float32
  Trainer trainer(Initial(), dataset_, options);
  absl::Status status;
  while (status.ok() && !trainer.done()) status = trainer.Step().status();
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(status.message()), HasSubstr("tensor \""));
}

class TrainerModeTest : public TrainerTest, public testing::WithParamInterface<Mode> {};

TEST_P(TrainerModeTest, LearnsToImitate) {
  const Dataset experts = *RecordDataset({.seed = 0, .steps = 2000, .expert_fraction = 1.0});
  TrainOptions options = With([](TrainOptions& o) {
    o.iterations = 100;
    o.batch = 8;
    o.learning_rate = 5e-3;
    o.warmup = 10;
  });
  for (const Arithmetic arithmetic : {Arithmetic::kFloat32, Arithmetic::kInt8}) {
    if (GetParam() == Mode::kDense && arithmetic == Arithmetic::kInt8) continue;
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

TEST(TrainOptionsTest, BadOptionsAreNamed) {
  EXPECT_TRUE(TrainOptions{}.Validate().ok());
  EXPECT_EQ(With([](TrainOptions& o) { o.batch = 0; }).Validate().message(),
            "batch: expected at least 1, received 0");
  EXPECT_EQ(With([](TrainOptions& o) { o.action_noise = 2.0; }).Validate().message(),
            "action_noise: expected 0 to 1, received 2");
  EXPECT_EQ(With([](TrainOptions& o) { o.rate_targets.hidden = -0.01; }).Validate().message(),
            "target_rate: expected 0 to 100 percent, received -1");
}

}  // namespace
}  // namespace spikeserve
