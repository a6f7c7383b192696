#include "core/dataset/amendments.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <string>
#include <vector>

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

Dataset Recorded() {
  Dataset dataset = {.environment = "Test-v0",
                     .observation_size = 1,
                     .action_space = ActionSpace::Discrete(2),
                     .episodes = {}};
  Episode episode;
  episode.actor = "served";
  episode.observations = {0.0f, 1.0f, 2.0f, 3.0f};
  episode.actions.resize(3);
  episode.actions[1].discrete = 1;
  episode.rewards = {1.0, 1.0, 0.5};
  episode.truncated = true;
  episode.served.emplace();
  episode.served->session = "some";
  episode.served->returns_to_go = {3.0f, 2.0f, 1.0f};
  episode.served->probabilities = {0.5f, 0.5f, 0.5f, 0.5f, 0.5f, 0.5f};
  episode.served->spikes = {1, 2, 3};
  dataset.episodes.push_back(episode);
  return dataset;
}

TEST(AmendmentsTest, ReadersTakeTheLastRewardsAndKeepThoseReceived) {
  const std::string path = ::testing::TempDir() + "/000000.cbor";
  ASSERT_TRUE(WriteDataset(Recorded(), path).ok());
  EXPECT_EQ(ReadDataset(path)->episodes[0].rewards, Recorded().episodes[0].rewards);
  ASSERT_TRUE(WriteAmendments(path, {{.id = "a", .rewards = {0.0, 0.1, 0.2}, .success = true},
                                     {.id = "b", .author = "ada", .reward = 2.0},
                                     {.id = "c", .label = "steady \"x\""}})
                  .ok());
  const auto read = ReadDataset(path);
  ASSERT_TRUE(read.ok()) << read.status();
  const Episode& episode = read->episodes[0];
  EXPECT_EQ(episode.rewards, (std::vector<double>{1.0, 1.0, 2.5}));
  EXPECT_EQ(episode.received_rewards(), (std::vector<double>{1.0, 1.0, 0.5}));
  EXPECT_EQ(episode.served->success, true);
  EXPECT_EQ(episode.served->verdict, "steady \"x\"");
  // What was amended stays so in a dataset that is made of it.
  const std::string copy = ::testing::TempDir() + "/copy.cbor";
  ASSERT_TRUE(WriteDataset(*read, copy).ok());
  EXPECT_EQ(ReadDataset(copy)->episodes[0].rewards, episode.rewards);
  EXPECT_EQ(ReadDataset(copy)->episodes[0].received_rewards(), episode.received_rewards());
}

TEST(AmendmentsTest, WhatDoesNotFitIsRefusedWithItsFile) {
  const std::string path = ::testing::TempDir() + "/000001.cbor";
  ASSERT_TRUE(WriteDataset(Recorded(), path).ok());
  ASSERT_TRUE(WriteAmendments(path, {{.id = "a", .rewards = {1.0}}}).ok());
  EXPECT_THAT(std::string(ReadDataset(path).status().message()),
              HasSubstr("000001.amendments: rewards: expected 3 numbers, one a step, received 1"));
  std::ofstream(::testing::TempDir() + "/000001.amendments") << "{\"amendment_id\": \"a\"\n";
  EXPECT_THAT(std::string(ReadDataset(path).status().message()), HasSubstr("000001.amendments"));
}

TEST(AmendmentsTest, AFileThatCannotBeReadIsNotTakenForNone) {
  const std::string path = ::testing::TempDir() + "/000002.cbor";
  ASSERT_TRUE(WriteDataset(Recorded(), path).ok());
  std::filesystem::create_directory(::testing::TempDir() + "/000002.amendments");
  const auto read = ReadDataset(path);
  EXPECT_THAT(std::string(read.status().message()),
              HasSubstr("000002.amendments: expected a file"));
}

}  // namespace
}  // namespace spikeserve
