// Tests of all experts, with coarse tables.
#include "train/expert/expert.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <fstream>

#include "train/expert/expert_evaluation.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;

double MeanReturn(const ExpertOptions& options, int episodes) {
  const std::unique_ptr<Expert> expert = *MakeExpert(options);
  return StatisticsOf(*EvaluateExpert(*expert, options.environment, episodes, 0)).mean;
}

TEST(ExpertTest, CartPoleIsBalanced) { EXPECT_EQ(MeanReturn({}, 20), 500.0); }

TEST(ExpertTest, MountainCarClimbsOnACoarseTable) {
  EXPECT_GT(MeanReturn({.environment = "MountainCar-v0", .coarsening = 8}, 50), -105.0);
}

TEST(ExpertTest, PendulumSwingsUpOnACoarseTable) {
  EXPECT_GT(MeanReturn({.environment = "Pendulum-v1", .coarsening = 8}, 50), -200.0);
}

TEST(ExpertTest, RobustPendulumSwingsUpOnACoarseTable) {
  EXPECT_GT(MeanReturn({.environment = "Pendulum-v1", .name = "robust", .coarsening = 8}, 50),
            -220.0);
}

TEST(ExpertTest, AcrobotSwingsUpOnACoarseTableAndABeamIsBest) {
  ExpertOptions options = {.environment = "Acrobot-v1", .beam_width = 200, .coarsening = 4};
  const double beam = MeanReturn(options, 3);
  options.name = "greedy";
  const double greedy = MeanReturn(options, 3);
  EXPECT_GT(beam, -80.0);
  EXPECT_GT(beam, greedy);
}

TEST(ExpertTest, CautiousPendulumSwingsUpOnACoarseTable) {
  EXPECT_GT(MeanReturn({.environment = "Pendulum-v1", .name = "cautious", .coarsening = 8}, 50),
            -220.0);
}

// Every episode lasts the number of steps that is drawn from its seed.
TEST(ExpertTest, DialsLastAsLongAsTheyAreAsked) {
  const std::unique_ptr<Expert> cart_pole = *MakeExpert({.name = "dial"});
  const std::vector<double> returns = *EvaluateExpert(*cart_pole, "CartPole-v1", 50, 0);
  const auto [least, most] = std::minmax_element(returns.begin(), returns.end());
  EXPECT_LT(*least, 100.0);
  EXPECT_GT(*most, 400.0);
  EXPECT_NEAR(StatisticsOf(returns).mean, 255.0, 70.0);

  const std::unique_ptr<Expert> car =
      *MakeExpert({.environment = "MountainCar-v0", .name = "dial", .coarsening = 8});
  const std::vector<double> climbs = *EvaluateExpert(*car, "MountainCar-v0", 50, 0);
  EXPECT_NEAR(StatisticsOf(climbs).mean, -150.0, 15.0);
}

TEST(ExpertTest, WhatNobodySeesDoesNotHinderAnExpert) {
  EXPECT_EQ(MeanReturn({.environment = "PositionOnlyCartPole-v1"}, 5), 500.0);
}

TEST(ExpertTest, StakesAreHighWhereAChoiceMatters) {
  const std::unique_ptr<Expert> pendulum =
      *MakeExpert({.environment = "Pendulum-v1", .coarsening = 8});
  const double upright = pendulum->StateImportance(std::vector<double>{0.2, 0.0});
  const double fast = pendulum->StateImportance(std::vector<double>{3.1, 8.0});
  EXPECT_GT(upright, 0.0);
  EXPECT_GT(upright, fast);
  EXPECT_EQ((*MakeExpert({}))->StateImportance(std::vector<double>(4)), 1.0);
}

TEST(ExpertTest, TablesAreSolvedOnceAndReadAgain) {
  const std::string directory =
      (std::filesystem::path(testing::TempDir()) / "expert_tables").string();
  std::filesystem::remove_all(directory);
  ExpertOptions options = {
      .environment = "MountainCar-v0", .tables_directory = directory, .coarsening = 8};
  const double solved = MeanReturn(options, 20);
  const std::string path = directory + "/mountain_car-coarse.safetensors";
  ASSERT_TRUE(std::filesystem::exists(path));
  const auto written = std::filesystem::last_write_time(path);
  EXPECT_EQ(MeanReturn(options, 20), solved);
  EXPECT_EQ(std::filesystem::last_write_time(path), written);

  std::ofstream(path) << "not a table";
  EXPECT_THAT(std::string(MakeExpert(options).status().message()), HasSubstr(path));
  options.coarsening = 4;  // the same file, another shape
  std::filesystem::remove(path);
  ASSERT_TRUE(MakeExpert(options).ok());
  options.coarsening = 8;
  EXPECT_EQ(MakeExpert(options).status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(ExpertTest, UnknownOnesAreNamed) {
  EXPECT_EQ(
      MakeExpert({.environment = "Pendulum-v1", .name = "beam"}).status().message(),
      "expert: expected value_iteration, robust or cautious for Pendulum-v1, received 'beam'");
  EXPECT_THAT(std::string(MakeExpert({.environment = "Pong"}).status().message()),
              HasSubstr("none for 'Pong'"));
  EXPECT_EQ(MakeExpert({.beam_width = 0}).status().message(),
            "beam_width: expected at least 1, received 0");
}

}  // namespace
}  // namespace spikeserve
