// Tests of `spikectl adapt` with a real server. The policies are random, so these tests do not
// check how well they learn.
#include <string>
#include <vector>

#include "tests/integration/client_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

class SpikectlAdaptTest : public ClientProgramTest {
 protected:
  Finished Adapt(std::vector<std::string> flags) {
    flags.insert(flags.begin(), {"--env=CartPole-v1", "--episodes=3", "--seed=5"});
    return Spikectl("adapt", flags);
  }
};

TEST_F(SpikectlAdaptTest, OneSessionLearns) {
  const nlohmann::json result = ParseOutput(Adapt({"--perturb=force=-1", "--json"}));
  std::vector<std::string> keys;
  for (const auto& item : result.items()) keys.push_back(item.key());
  EXPECT_THAT(
      keys, ::testing::UnorderedElementsAre("unperturbed_return", "frozen_return", "adapted_return",
                                            "episodes", "curve", "head_drift", "rollbacks"));
  EXPECT_EQ(result["episodes"], 3);
  EXPECT_EQ(result["curve"].size(), 3u);
  EXPECT_GT(result["head_drift"].get<double>(), 0.0);
  EXPECT_NE(result["adapted_return"], result["frozen_return"]);
  EXPECT_EQ(Metric("spikeserve_learning_updates_total"), 3.0);
  EXPECT_EQ(Metric("spikeserve_sessions"), 0.0);
  // The result depends only on the seed.
  EXPECT_EQ(ParseOutput(Adapt({"--perturb=force=-1", "--json"})), result);
}

TEST_F(SpikectlAdaptTest, AFleetLearns) {
  const nlohmann::json result =
      ParseOutput(Adapt({"--perturb=wind=4", "--scope=fleet", "--fleet=4", "--json"}));
  EXPECT_EQ(result["curve"].size(), 3u);
  EXPECT_GT(result["head_drift"].get<double>(), 0.0);
  EXPECT_EQ(Metric("spikeserve_learning_updates_total"), 12.0);
  EXPECT_EQ(Metric("spikeserve_sessions"), 0.0);
}

TEST_F(SpikectlAdaptTest, TheTaskMayStayAsItIs) {
  const nlohmann::json result = ParseOutput(Adapt({"--json"}));
  EXPECT_EQ(result["frozen_return"], result["unperturbed_return"]);
}

TEST_F(SpikectlAdaptTest, PrintsTheCurve) {
  const Finished text = Adapt({"--perturb=length=2"});
  EXPECT_EQ(text.exit_code, 0) << text.errors;
  EXPECT_THAT(text.output,
              HasSubstr("CartPole-v1 with length=2, policy cartpole-v1/1, 1 learning"));
  EXPECT_THAT(text.output, HasSubstr(" |####"));
  EXPECT_THAT(text.output, HasSubstr("greedy, mean of 50 unseen starts: "));
}

TEST_F(SpikectlAdaptTest, SaysInOneLineWhatIsWrong) {
  ExpectOneLineError(Adapt({"--perturb=force"}), "--perturb: expected NAME=VALUE");
  ExpectOneLineError(Adapt({"--perturb=glue=1"}), "--perturb: expected one of wind, length");
  ExpectOneLineError(Adapt({"--scope=town"}),
                     "--scope: expected session or fleet, received \"town\"");
  ExpectOneLineError(Adapt({"--scope=fleet", "--fleet=0"}),
                     "--fleet: expected 1 to 1000, received 0");
  ExpectOneLineError(
      Adapt({"--rule=habit"}),
      "--rule: expected policy_gradient, hebbian or hebbian_action, received \"habit\"");
  ExpectOneLineError(Adapt({"--learning_rate=-1"}), "--learning_rate: expected");
  ExpectOneLineError(Adapt({"--episodes=0"}), "--episodes: expected at least 1, received 0");
}

}  // namespace
}  // namespace spikeserve
