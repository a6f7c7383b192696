// Tests of Minari's layout: round trips and refused files. Tests in tests/python check that Minari
// itself reads and writes the same files.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <hdf5.h>
#include <unistd.h>

#include <csignal>
#include <filesystem>
#include <fstream>
#include <functional>
#include <new>
#include <sstream>
#include <stdexcept>

#include "absl/strings/str_replace.h"
#include "tests/support/read_minari.h"
#include "train/data/child_reader.h"
#include "train/data/hdf5_file.h"
#include "train/data/minari_writer.h"
#include "train/recording/record.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;

std::string TemporaryDirectory(const std::string& name) {
  const auto path = std::filesystem::path(testing::TempDir()) / name;
  std::filesystem::remove_all(path);
  return path.string();
}

// Replaces `from` by `to` in the metadata of the dataset in `directory`.
void EditMetadata(const std::string& directory, const std::string& from, const std::string& to) {
  const std::string path = directory + "/data/metadata.json";
  std::stringstream text;
  text << std::ifstream(path).rdbuf();
  ASSERT_THAT(text.str(), HasSubstr(from));
  std::ofstream(path) << absl::StrReplaceAll(text.str(), {{from, to}});
}

void ExpectSame(const Dataset& read, const Dataset& written) {
  EXPECT_EQ(read.environment, written.environment);
  EXPECT_EQ(read.observation_size, written.observation_size);
  EXPECT_EQ(read.action_space, written.action_space);
  EXPECT_EQ(read.recipe, written.recipe);
  ASSERT_EQ(read.episodes.size(), written.episodes.size());
  for (size_t i = 0; i < written.episodes.size(); ++i) {
    EXPECT_EQ(read.episodes[i].actor, written.episodes[i].actor);
    EXPECT_EQ(read.episodes[i].seed, written.episodes[i].seed);
    EXPECT_EQ(read.episodes[i].observations, written.episodes[i].observations);
    EXPECT_EQ(read.episodes[i].actions, written.episodes[i].actions);
    EXPECT_EQ(read.episodes[i].labels, written.episodes[i].labels);
    EXPECT_EQ(read.episodes[i].weights, written.episodes[i].weights);
    EXPECT_EQ(read.episodes[i].rewards, written.episodes[i].rewards);
    EXPECT_EQ(read.episodes[i].target_return, written.episodes[i].target_return);
    EXPECT_EQ(read.episodes[i].terminated, written.episodes[i].terminated);
    EXPECT_EQ(read.episodes[i].truncated, written.episodes[i].truncated);
  }
}

TEST(MinariTest, DiscreteActionsRoundTrip) {
  const std::string directory = TemporaryDirectory("cartpole-test-v0");
  const Dataset written = *RecordDataset(
      {.expert = {.name = "return_conditioned"}, .steps = 300, .disturbed_fraction = 0.3});
  ASSERT_TRUE(WriteMinariDataset(written, directory).ok());
  EXPECT_TRUE(IsMinariDataset(directory));
  const absl::StatusOr<Dataset> read = ReadMinariDataset(directory);
  ASSERT_TRUE(read.ok()) << read.status();
  ExpectSame(*read, written);
}

TEST(MinariTest, BoxActionsLabelsAndWeightsRoundTrip) {
  const std::string directory = TemporaryDirectory("pendulum-test-v12");
  const Dataset written = *RecordDataset({.expert = {.environment = "Pendulum-v1", .coarsening = 8},
                                          .steps = 600,
                                          .expert_fraction = 0.0,
                                          .disturbed_fraction = 0.5,
                                          .weigh = true});
  ASSERT_TRUE(WriteMinariDataset(written, directory).ok());
  const absl::StatusOr<Dataset> read = ReadMinariDataset(directory);
  ASSERT_TRUE(read.ok()) << read.status();
  ASSERT_FALSE(read->episodes[0].weights.empty());
  ExpectSame(*read, written);
}

TEST(MinariTest, ServedEpisodesSayWhoDecidedAndOnWhat) {
  const std::string directory = TemporaryDirectory("served-v0");
  Dataset written = *RecordDataset({.steps = 50});
  written.episodes.resize(1);
  Episode& episode = written.episodes[0];
  const auto steps = static_cast<size_t>(episode.steps());
  episode.served.emplace();
  episode.served->policy = "cartpole";
  episode.served->version = 3;
  for (size_t i = 0; i < steps; ++i) {
    episode.served->returns_to_go.push_back(500.0f - static_cast<float>(i));
  }
  ASSERT_TRUE(WriteMinariDataset(written, directory).ok());
  const auto file = Hdf5File::Open(directory + "/data/main_data.hdf5");
  ASSERT_TRUE(file.ok()) << file.status();
  EXPECT_EQ(file->ReadString("episode_0", "policy").value_or(""), "cartpole");
  EXPECT_EQ(file->ReadInteger("episode_0", "policy_version").value_or(0), 3);
  const auto returns = file->Read<float>("episode_0/infos/return_to_go");
  ASSERT_TRUE(returns.ok()) << returns.status();
  ASSERT_EQ(returns->values.size(), steps + 1);
  EXPECT_EQ(returns->values.front(), 500.0f);
  EXPECT_EQ(returns->values.back(), 500.0f - static_cast<float>(steps));
}

TEST(MinariTest, ADatasetFromElsewhereHasTheEnvironmentOfItsSpec) {
  const std::string directory = TemporaryDirectory("elsewhere-v0");
  ASSERT_TRUE(WriteMinariDataset(*RecordDataset({.steps = 50}), directory).ok());
  EditMetadata(directory, "\"spikeserve\"", "\"another\"");
  const absl::StatusOr<Dataset> read = ReadMinariDataset(directory);
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_EQ(read->environment, "CartPole-v1");
  EXPECT_EQ(read->recipe["minari"], "elsewhere-v0");
}

TEST(MinariTest, LabelsAndWeightsOfADatasetFromElsewhereAreRead) {
  const std::string directory = TemporaryDirectory("labelled-v0");
  Dataset written = *RecordDataset({.steps = 300, .disturbed_fraction = 0.3});
  for (Episode& episode : written.episodes) {
    episode.weights.assign(episode.actions.size(), 0.5f);
  }
  ASSERT_TRUE(WriteMinariDataset(written, directory).ok());
  EditMetadata(directory, "\"spikeserve\"", "\"another\"");
  const absl::StatusOr<Dataset> read = ReadMinariDataset(directory);
  ASSERT_TRUE(read.ok()) << read.status();
  written.recipe = {{"minari", "labelled-v0"}};
  ExpectSame(*read, written);
}

TEST(MinariTest, IndicesAreCountedFromTheStartOfTheSpace) {
  const std::string directory = TemporaryDirectory("started-v0");
  Dataset written = *RecordDataset({.steps = 50});
  written.action_space = ActionSpace::Discrete(3);
  for (Episode& episode : written.episodes) {
    for (Action& action : episode.actions) action.discrete += 1;
  }
  ASSERT_TRUE(WriteMinariDataset(written, directory).ok());
  EditMetadata(directory, R"(\"start\":0)", R"(\"start\":1)");
  const absl::StatusOr<Dataset> read = ReadMinariDataset(directory);
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_EQ(read->action_space, ActionSpace::Discrete(3));
  for (size_t i = 0; i < written.episodes.size(); ++i) {
    for (size_t step = 0; step < written.episodes[i].actions.size(); ++step) {
      EXPECT_EQ(read->episodes[i].actions[step].discrete,
                written.episodes[i].actions[step].discrete - 1);
    }
  }
}

// Writes a dataset of two steps from elsewhere, whose actions are pairs, with `weights` weights.
void WriteTinyMultiDiscrete(const std::string& directory, int64_t weights) {
  Dataset written = *RecordDataset({.steps = 50});
  written.episodes.resize(1);
  ASSERT_TRUE(WriteMinariDataset(written, directory).ok());
  EditMetadata(directory, R"(\"type\":\"Discrete\")", R"(\"type\":\"MultiDiscrete\")");
  EditMetadata(directory, R"(\"n\":2)", R"(\"nvec\":[2, 3])");
  EditMetadata(directory, R"(\"start\":0)", R"(\"start\":[0, 4])");
  auto file = Hdf5File::Create(directory + "/data/main_data.hdf5");
  ASSERT_TRUE(file.ok()) << file.status();
  const std::vector<float> zeros(12);
  const std::vector<int64_t> actions = {0, 6, 1, 5};
  const std::vector<double> rewards(2);
  const std::vector<uint8_t> ends(2);
  ASSERT_TRUE(file->CreateGroup("episode_0").ok());
  ASSERT_TRUE(file->CreateGroup("episode_0/infos").ok());
  ASSERT_TRUE(file->Write<float>("episode_0/observations", {3, 4}, zeros).ok());
  ASSERT_TRUE(file->Write<int64_t>("episode_0/actions", {2, 2}, actions).ok());
  ASSERT_TRUE(file->Write<double>("episode_0/rewards", {2, {}}, rewards).ok());
  ASSERT_TRUE(file->Write<uint8_t>("episode_0/terminations", {2, {}}, ends).ok());
  ASSERT_TRUE(file->Write<uint8_t>("episode_0/truncations", {2, {}}, ends).ok());
  ASSERT_TRUE(file->Write<float>("episode_0/infos/weight", {weights, {}}, zeros).ok());
  ASSERT_TRUE(file->Close().ok());
}

TEST(MinariTest, TheLastElementOfAMultiDiscreteChangesFastest) {
  const std::string directory = TemporaryDirectory("joint-v0");
  WriteTinyMultiDiscrete(directory, /*weights=*/2);
  const absl::StatusOr<Dataset> read = ReadMinariDataset(directory);
  ASSERT_TRUE(read.ok()) << read.status();
  EXPECT_EQ(read->action_space, ActionSpace::Discrete(6));
  EXPECT_EQ(read->episodes[0].actions[0].discrete, 2);  // 0 * 3 + (6 - 4)
  EXPECT_EQ(read->episodes[0].actions[1].discrete, 4);  // 1 * 3 + (5 - 4)
}

TEST(MinariTest, WeightsOfOnlySomeStepsAreRefused) {
  const std::string directory = TemporaryDirectory("short-v0");
  WriteTinyMultiDiscrete(directory, /*weights=*/1);
  EXPECT_THAT(std::string(ReadMinariDataset(directory).status().message()),
              HasSubstr("episode_0/infos/weight: expected 2 or 3 rows, received 1"));
}

TEST(MinariTest, WhatCannotBeReadIsRefusedWithPathAndReason) {
  const Dataset dataset = *RecordDataset({.steps = 50});
  EXPECT_THAT(std::string(WriteMinariDataset(dataset, "/tmp/plain").message()),
              HasSubstr("NAME-v0, received plain"));
  const std::string directory = TemporaryDirectory("broken-v0");
  EXPECT_EQ(ReadMinariDataset(directory).status().code(), absl::StatusCode::kNotFound);

  const auto expect_refusal = [&](const std::string& from, const std::string& to,
                                  const std::string& reason) {
    ASSERT_TRUE(WriteMinariDataset(dataset, directory).ok());
    EditMetadata(directory, from, to);
    const absl::Status status = ReadMinariDataset(directory).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
    EXPECT_THAT(std::string(status.message()),
                testing::AllOf(HasSubstr(directory), HasSubstr(reason)));
  };
  expect_refusal(R"(\"type\":\"Discrete\")", R"(\"type\":\"MultiBinary\")",
                 "action_space: expected Discrete, MultiDiscrete or Box, received MultiBinary");
  expect_refusal(R"(\"start\":0)", R"(\"start\":1)",
                 "episode_0/actions: expected 1 to 2, received 0 at step");
  expect_refusal(R"(\"n\":2)", R"(\"n\":5000)", "expected 1 to 4096 indices, received 5000");
  expect_refusal(R"(\"n\":2)", R"(\"n\":[64, 65])", "at most 4096 combinations, received more");
  expect_refusal(R"(\"n\":2)", R"(\"n\":[2, 2])",
                 "episode_0/actions: expected 2 values an action, received 1");
  expect_refusal(R"(\"type\": \"Box\")", R"(\"type\": \"Dict\")",
                 "observation_space: expected Box, received Dict");
  expect_refusal(R"(\"shape\": [4])", R"(\"shape\": [5])", "episode_0: observations: expected");
  expect_refusal(R"(\"shape\": [4])", R"(\"shape\": [2000000000, 2000000000])",
                 "observation_space: expected dimensions of at least 1 and at most 1048576");
  expect_refusal(R"(\"shape\": [4])", R"(\"shape\": [-4])", "received a dimension of -4");
  expect_refusal(R"(\"start\":0)", R"(\"start\":-9223372036854775808)",
                 "action_space.start: expected");
  expect_refusal("dataset_id", "id", "metadata: expected key \"dataset_id\", received none");
  std::filesystem::remove(directory + "/data/main_data.hdf5");
  ASSERT_TRUE(WriteMinariDataset(dataset, directory).ok());
  std::ofstream(directory + "/data/main_data.hdf5") << "not HDF5";
  EXPECT_THAT(std::string(ReadMinariDataset(directory).status().message()),
              HasSubstr("cannot read as HDF5"));
}

// Values at positions of the file that an attacker chooses: the HDF5 library may crash, take memory
// or run without end, but not in this process.
TEST(MinariTest, DamagedFilesAreErrors) {
  const Dataset dataset = *RecordDataset({.steps = 50});
  const std::string directory = TemporaryDirectory("damaged-v0");
  ASSERT_TRUE(WriteMinariDataset(dataset, directory).ok());
  const std::string path = directory + "/data/main_data.hdf5";
  std::stringstream whole;
  whole << std::ifstream(path, std::ios::binary).rdbuf();
  int refused = 0;
  for (int i = 0; i < 200; ++i) {
    std::string bytes = whole.str();
    const size_t position = 8 + i * 37 % 4000;
    bytes[position] = static_cast<char>(0xff - i % 3);
    std::ofstream(path, std::ios::binary) << bytes;
    const absl::Status status = ReadMinariDataset(directory).status();
    if (status.ok()) continue;
    ++refused;
    EXPECT_THAT(std::string(status.message()), HasSubstr(directory));
  }
  EXPECT_GT(refused, 0);
}

TEST(MinariTest, AttributesAndArraysThatClaimTooMuchAreErrors) {
  const std::string path = TemporaryDirectory("large.hdf5");
  const hid_t file = H5Fcreate(path.c_str(), H5F_ACC_TRUNC, H5P_DEFAULT, H5P_DEFAULT);
  const hsize_t many = 1000;
  const hid_t row = H5Screate_simple(1, &many, nullptr);
  H5Aclose(H5Acreate2(file, "seed", H5T_NATIVE_INT64, row, H5P_DEFAULT, H5P_DEFAULT));
  const hsize_t huge[] = {hsize_t{1} << 31, hsize_t{1} << 31};
  const hid_t square = H5Screate_simple(2, huge, nullptr);
  const hid_t properties = H5Pcreate(H5P_DATASET_CREATE);
  const hsize_t chunk[] = {1, 1};
  H5Pset_chunk(properties, 2, chunk);
  H5Dclose(H5Dcreate2(file, "x", H5T_NATIVE_FLOAT, square, H5P_DEFAULT, properties, H5P_DEFAULT));
  H5Fclose(file);
  const auto opened = Hdf5File::Open(path);
  ASSERT_TRUE(opened.ok()) << opened.status();
  EXPECT_EQ(opened->ReadInteger(".", "seed").status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(opened->Read<float>("x").status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(ChildReaderTest, TheEndOfTheChildIsAnError) {
  const auto crash = [](const std::function<void()>& end) {
    return ReadInChild([&]() -> absl::StatusOr<Dataset> {
             end();
             return Dataset();
           })
        .status();
  };
  EXPECT_THAT(std::string(crash([] { raise(SIGKILL); }).message()), HasSubstr("signal 9"));
  EXPECT_THAT(std::string(crash([] { _exit(3); }).message()), HasSubstr("exit status 3"));
  const absl::Status memory = crash([] { throw std::bad_alloc(); });
  EXPECT_EQ(memory.code(), absl::StatusCode::kResourceExhausted);
  const absl::Status thrown = crash([] { throw std::length_error("too long"); });
  EXPECT_EQ(thrown, absl::InvalidArgumentError("too long"));
}

}  // namespace
}  // namespace spikeserve
