// Tests of the program spikectl with a real server.
#include <cmath>

#include "absl/strings/str_cat.h"
#include "tests/integration/client_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;
using ::testing::Not;
using ::testing::StartsWith;
using ::testing::UnorderedElementsAre;

std::vector<std::string> Keys(const nlohmann::json& object) {
  std::vector<std::string> keys;
  for (const auto& item : object.items()) keys.push_back(item.key());
  return keys;
}

class SpikectlTest : public ClientProgramTest {};

TEST_F(SpikectlTest, ListsThePolicies) {
  const nlohmann::json listed = ParseOutput(Spikectl("policies", {"--json"}));
  ASSERT_EQ(listed["policies"].size(), 4u);
  const nlohmann::json& cart_pole = listed["policies"][1];
  EXPECT_EQ(cart_pole["name"], "cartpole-v1");
  EXPECT_EQ(cart_pole["version"], 1);
  EXPECT_EQ(cart_pole["is_default"], true);
  EXPECT_EQ(cart_pole["environment"], "CartPole-v1");
  EXPECT_EQ(cart_pole["observation_size"], 4);
  EXPECT_EQ(cart_pole["action_space"]["n"], 2);
  EXPECT_EQ(cart_pole["target_return"], 100.0);

  const Finished text = Spikectl("policies");
  EXPECT_EQ(text.exit_code, 0) << text.errors;
  EXPECT_THAT(text.output, HasSubstr("pendulum-v1"));
}

TEST_F(SpikectlTest, PlaysEveryEnvironmentAndAgreesWithTheServersMetrics) {
  for (const std::string id : kEnvironments) {
    SCOPED_TRACE(id);
    const double decisions_before = Metric("spikeserve_decisions_total");
    const double spikes_before = Metric("spikeserve_spikes_total");
    const nlohmann::json run =
        ParseOutput(Spikectl("run", {"--env=" + id, "--episodes=3", "--seed=11", "--json"}));
    const double decisions = Metric("spikeserve_decisions_total") - decisions_before;
    const double spikes = Metric("spikeserve_spikes_total") - spikes_before;

    EXPECT_THAT(Keys(run), UnorderedElementsAre("episodes", "mean_return", "spikes_per_decision",
                                                "energy_joules_per_decision", "energy_model",
                                                "energy_models", "p50_seconds", "p99_seconds"));
    ASSERT_EQ(run["episodes"].size(), 3u);
    double steps = 0.0, returns = 0.0, episode_spikes = 0.0;
    for (const nlohmann::json& episode : run["episodes"]) {
      EXPECT_THAT(Keys(episode), UnorderedElementsAre("return", "steps", "spikes_per_decision"));
      steps += episode["steps"].get<double>();
      returns += episode["return"].get<double>();
      episode_spikes +=
          std::round(episode["steps"].get<double>() * episode["spikes_per_decision"].get<double>());
    }
    EXPECT_EQ(steps, decisions);
    EXPECT_EQ(episode_spikes, spikes);
    EXPECT_DOUBLE_EQ(run["mean_return"].get<double>(), returns / 3.0);
    EXPECT_DOUBLE_EQ(run["spikes_per_decision"].get<double>(), spikes / decisions);
    EXPECT_EQ(run["energy_model"], "horowitz_45nm");
    const nlohmann::json& models = run["energy_models"];
    EXPECT_THAT(Keys(models), UnorderedElementsAre("horowitz_45nm", "spike_5pj"));
    EXPECT_EQ(run["energy_joules_per_decision"], models["horowitz_45nm"]["joules_per_decision"]);
    EXPECT_NEAR(models["spike_5pj"]["joules_per_decision"].get<double>(),
                5e-12 * spikes / decisions, 1e-15);
    EXPECT_GT(run["p50_seconds"].get<double>(), 0.0);
    EXPECT_GE(run["p99_seconds"].get<double>(), run["p50_seconds"].get<double>());
  }
  EXPECT_EQ(Metric("spikeserve_sessions"), 0.0);
}

TEST_F(SpikectlTest, EpisodeISeesTheStartOfSeedPlusI) {
  const auto returns = [&](const std::string& episodes, const std::string& seed) {
    const nlohmann::json run = ParseOutput(Spikectl(
        "run", {"--env=Pendulum-v1", "--episodes=" + episodes, "--seed=" + seed, "--json"}));
    std::vector<double> list;
    for (const nlohmann::json& episode : run["episodes"]) list.push_back(episode["return"]);
    return list;
  };
  const std::vector<double> three = returns("3", "100");
  ASSERT_EQ(three.size(), 3u);
  EXPECT_NE(three[0], three[1]);
  EXPECT_EQ(returns("2", "101"), std::vector<double>({three[1], three[2]}));
}

TEST_F(SpikectlTest, PrintsALineForEveryEpisodeAndASummary) {
  const Finished run = Spikectl("run", {"--env=CartPole-v1", "--episodes=2", "--seed=1000000"});
  EXPECT_EQ(run.exit_code, 0) << run.errors;
  EXPECT_EQ(run.errors, "");
  EXPECT_THAT(run.output, HasSubstr("CartPole-v1 with policy cartpole-v1/1 (full)"));
  EXPECT_THAT(run.output,
              HasSubstr(" nJ a decision by the estimate horowitz_45nm, without memory\n"));
  EXPECT_THAT(run.output, HasSubstr(" 1000000 "));
  EXPECT_THAT(run.output, HasSubstr(" 1000001 "));
  EXPECT_THAT(run.output, HasSubstr("mean return"));
}

TEST_F(SpikectlTest, QuietlyItPrintsADotForAnEpisodeAndTheSummary) {
  const Finished run =
      Spikectl("run", {"--env=CartPole-v1", "--episodes=3", "--seed=1000000", "--quiet"});
  EXPECT_EQ(run.exit_code, 0) << run.errors;
  EXPECT_THAT(run.output,
              StartsWith("CartPole-v1 with policy cartpole-v1/1 (full) ...\nmean return "));
  EXPECT_THAT(run.output, Not(HasSubstr("1000001")));
}

TEST_F(SpikectlTest, APolicyVersionAndTargetReturnMayBeNamed) {
  EXPECT_EQ(Spikectl("run", {"--env=Acrobot-v1", "--policy=acrobot-v1", "--version=1",
                             "--target_return=-80"})
                .exit_code,
            0);
}

TEST_F(SpikectlTest, ExplainsADecisionOfASessionItPlays) {
  const nlohmann::json explained =
      ParseOutput(Spikectl("explain", {"--env=Acrobot-v1", "--steps=6", "--seed=3", "--json"}));
  EXPECT_EQ(explained["answer"]["step"], "5");  // JSON's form of an int64 in proto3
  uint64_t spikes = 0;
  for (const nlohmann::json& raster : explained["rasters"]) {
    ASSERT_EQ(raster["ticks"].size(), raster["neurons"].size());
    spikes += raster["ticks"].size();
  }
  EXPECT_EQ(explained["answer"]["stats"]["spikes"], std::to_string(spikes));
  EXPECT_EQ(Metric("spikeserve_sessions"), 0.0);

  const Finished text = Spikectl("explain", {"--env=Acrobot-v1", "--steps=6", "--seed=3"});
  EXPECT_EQ(text.exit_code, 0) << text.errors;
  EXPECT_THAT(text.output, HasSubstr("acrobot-v1/1 (full), session "));
  EXPECT_THAT(text.output, HasSubstr("layer 0 coder of s_5: "));
  EXPECT_THAT(text.output, HasSubstr("layer 1 gates of s_5, mean over ticks: "));
  EXPECT_THAT(text.output, HasSubstr("layer 1 head 1 attends most to: "));
}

TEST_F(SpikectlTest, ExplainsASessionOfSomebodyElse) {
  const std::string session = client_->Open("cartpole-v1");
  ExpectOneLineError(Spikectl("explain", {"--session=" + session}),
                     "expected a session that has decided");
  client_->Act(session, 0);
  const nlohmann::json explained =
      ParseOutput(Spikectl("explain", {"--session=" + session, "--json"}));
  EXPECT_EQ(explained["session_id"], session);
  EXPECT_EQ(Metric("spikeserve_sessions"), 1.0);
  ExpectOneLineError(Spikectl("explain", {"--session=nobody"}), "nobody");
  ExpectOneLineError(Spikectl("explain", {"--steps=0"}),
                     "--steps: expected at least 1, received 0");
}

TEST_F(SpikectlTest, SaysInOneLineWhatIsWrong) {
  ExpectOneLineError(
      Spikectl("fly"),
      "command: expected one of policies, health, run, explain, adapt, replay, push, pull, rm, "
      "admin, store, emit-c, policy, doctor, received \"fly\"");
  ExpectOneLineError(Spikectl("run", {"land"}), "expected flags alone, received \"land\"");
  ExpectOneLineError(Spikectl("run", {"--env=Pong-v0"}), "\"Pong-v0\"");
  ExpectOneLineError(Spikectl("run", {"--episodes=0"}),
                     "--episodes: expected at least 1, received 0");
  ExpectOneLineError(Spikectl("run", {"--episodes=many"}),
                     "--episodes: expected an integer, received \"many\"");
  ExpectOneLineError(Spikectl("run", {"--seed=-1"}),
                     "--seed: expected an integer of at least 0, received \"-1\"");
  ExpectOneLineError(Spikectl("run", {"--version=-1"}),
                     "--version: expected at least 0, received -1");
  ExpectOneLineError(Spikectl("run", {"--target_return=inf"}), "--target_return");
  ExpectOneLineError(Spikectl("run", {"--altitude=3"}),
                     "--altitude: expected a flag of spikectl run");
  ExpectOneLineError(Spikectl("run", {"--policy=nobody"}), "no policy \"nobody\" is served");
  ExpectOneLineError(Spikectl("run", {"--version=9"}), "version 9");
  ExpectOneLineError(Spikectl("run", {"--policy=pendulum-v1"}), "observations of length 3");
}

TEST_F(SpikectlTest, RefusesAFlagThatWouldDoNothing) {
  ExpectOneLineError(Spikectl("run", {"--fleet=3"}),
                     "--fleet: expected a flag of spikectl run (see spikectl run --help)");
  ExpectOneLineError(Spikectl("policies", {"--seed=1"}),
                     "--seed: expected a flag of spikectl policies");
  ExpectOneLineError(Spikectl("explain", {"--session=x", "--steps=3"}),
                     "--steps: expected no such flag beside --session, received 3");
}

TEST_F(SpikectlTest, WithoutAPolicyForTheEnvironmentItSaysWhatThereIs) {
  std::filesystem::remove_all(policies_.path() / "acrobot-v1");
  StartServer();
  ExpectOneLineError(Spikectl("run", {"--env=Acrobot-v1"}),
                     "no policy for Acrobot-v1 is served; the server has cartpole-v1/1");
}

TEST_F(SpikectlTest, AnUnreachableServerIsNamed) {
  const std::string address = server_->grpc_address();
  server_->Stop();
  ExpectOneLineError(Spikectl("policies"), absl::StrCat("no server could be reached at ", address));
}

}  // namespace
}  // namespace spikeserve
