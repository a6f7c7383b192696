// Plays shipped policies in the playground and compares what it says with an engine and an
// environment that are played here.
#include "client/playground/playground.h"

#include <gtest/gtest.h>

#include <memory>
#include <string>
#include <vector>

#include "core/base/file.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

std::string PolicyFile(const std::string& name) {
  return *ReadFile(std::string(SPIKESERVE_POLICIES) + "/" + name + "/policy.safetensors");
}

std::unique_ptr<Playground> Open(const std::string& name, uint64_t seed) {
  auto opened = Playground::Open(PolicyFile(name), seed);
  EXPECT_TRUE(opened.ok()) << opened.status();
  return *std::move(opened);
}

// Plays one episode until it ends. Returns its decisions.
std::vector<Json> PlayEpisode(Playground& playground) {
  std::vector<Json> decisions;
  do {
    decisions.push_back(*playground.Step());
  } while (!decisions.back()["ended"].get<bool>());
  return decisions;
}

TEST(PlaygroundTest, PlaysTheEpisodesOfItsSeeds) {
  const auto playground = Open("pendulum/1", 5);
  for (const uint64_t seed : {5u, 6u}) {
    const auto environment = *MakeEnvironment("Pendulum-v1");
    const std::vector<float> first = environment->Reset(seed);
    const std::vector<Json> decisions = PlayEpisode(*playground);
    EXPECT_EQ(decisions.front()["observation"].get<std::vector<float>>(), first);
    double sum = 0.0;
    for (const Json& decision : decisions) {
      EXPECT_EQ(decision["seed"], seed);
      const auto action = decision["answer"]["action"]["continuous"]["values"];
      sum += environment->Step({.continuous = action.get<std::vector<float>>()}).reward;
      EXPECT_EQ(decision["episode_return"], sum);
    }
    EXPECT_EQ(decisions.size(), 200u);
  }
}

TEST(PlaygroundTest, AnExplanationHasTheSpikesOfItsDecision) {
  const auto playground = Open("cartpole-small/1", 0);
  for (int step = 0; step < 4; ++step) {
    Json decision = *playground->Step();
    const Json explained = *playground->Explain();
    uint64_t spikes = 0;
    for (const Json& raster : explained["rasters"]) {
      EXPECT_EQ(raster["ticks"].size(), raster["neurons"].size());
      spikes += raster["ticks"].size();
    }
    EXPECT_EQ(decision["answer"]["stats"]["spikes"], spikes);
    EXPECT_EQ(explained["attention"].size(), explained["layers"]);
    for (const char* inside : {"rasters", "attention", "routing"})
      decision[inside] = explained[inside];
    EXPECT_EQ(decision, explained);
  }
}

TEST(PlaygroundTest, RefusesFilesThatItCannotPlay) {
  EXPECT_EQ(Playground::Open("no policy", 0).status().code(), absl::StatusCode::kInvalidArgument);
  const auto lander = Playground::Open(PolicyFile("lunar-lander/1"), 0).status();
  EXPECT_EQ(lander.code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(Open("cartpole-small/1", 0)->Explain().status().code(),
            absl::StatusCode::kFailedPrecondition);
}

}  // namespace
}  // namespace spikeserve
