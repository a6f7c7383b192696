// Tests of the program `spikectl admin` with a real server.
#include <algorithm>
#include <filesystem>

#include "tests/integration/client_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

class SpikectlAdminTest : public ClientProgramTest {
 protected:
  Finished Admin(const std::string& action, std::vector<std::string> flags) {
    flags.insert(flags.begin(), action);
    return Spikectl("admin", flags);
  }
  nlohmann::json AdminJson(const std::string& action, std::vector<std::string> flags) {
    flags.push_back("--json");
    return ParseOutput(Admin(action, flags));
  }

  void AddVersion2() {
    const auto folder = policies_.path() / "pendulum-v1";
    std::filesystem::copy(folder / "1", folder / "2");
  }
};

TEST_F(SpikectlAdminTest, RefusesAFlagThatWouldDoNothing) {
  ExpectOneLineError(Admin("reload", {"--policy=x"}),
                     "--policy: expected a flag of spikectl admin reload");
  ExpectOneLineError(Admin("load", {"--policy=x", "--label=y"}),
                     "--label: expected a flag of spikectl admin load");
}

TEST_F(SpikectlAdminTest, AVersionFromLoadToUnload) {
  AddVersion2();
  const std::string policy = "--policy=pendulum-v1";
  EXPECT_EQ(AdminJson("load", {policy, "--version=2"})["is_default"], false);
  EXPECT_EQ(AdminJson("default", {policy, "--version=2"})["version"], 2);
  EXPECT_EQ(AdminJson("default", {policy, "--version=1"})["version"], 1);
  EXPECT_EQ(AdminJson("label", {policy, "--version=2", "--label=canary"})["label"], "canary");
  const auto traffic = AdminJson("traffic", {policy, "--shares=1:90,2:10", "--shadow=2"});
  EXPECT_EQ(traffic["shares"][1]["percent"], 10);

  const auto listed = ParseOutput(Spikectl("policies", {"--json"}))["policies"];
  const auto& second = listed.back();
  EXPECT_EQ(second["version_labels"][0], "canary");
  EXPECT_EQ(second["traffic_percent"], 10);
  EXPECT_EQ(second["is_shadow"], true);

  ExpectOneLineError(Admin("unload", {policy, "--version=2"}), "FAILED_PRECONDITION");
  AdminJson("traffic", {policy, "--shares=none", "--shadow=0"});
  AdminJson("unlabel", {policy, "--label=canary"});
  AdminJson("unload", {policy, "--version=2"});
  EXPECT_EQ(AdminJson("reload", {})["loaded"].size(), 0u);
}

TEST_F(SpikectlAdminTest, SessionsAndDrain) {
  const std::string session = client_->Open("pendulum-v1");
  const auto sessions = AdminJson("sessions", {})["sessions"];
  ASSERT_EQ(sessions.size(), 1u);
  EXPECT_EQ(sessions[0]["session_id"], session);
  EXPECT_THAT(Admin("sessions", {}).output, HasSubstr(session));
  EXPECT_EQ(AdminJson("drain", {})["open_sessions"], 1);
  ExpectOneLineError(Spikectl("run", {"--env=Pendulum-v1"}), "draining");
  EXPECT_EQ(AdminJson("drain", {"--cancel"})["draining"], false);
}

TEST_F(SpikectlAdminTest, AFleetsHeadFromItsFirstEpisodeToAVersionOfItsOwn) {
  const std::string policy = "--policy=cartpole-v1";
  ExpectOneLineError(Admin("promote_head", {policy}), "FAILED_PRECONDITION");
  const auto learned = Spikectl("adapt", {"--env=CartPole-v1", "--scope=fleet", "--fleet=2",
                                          "--episodes=2", "--perturb=force=-1", "--json"});
  ParseOutput(learned);
  const auto head = AdminJson("head", {policy, "--weights"});
  EXPECT_EQ(head["version"], 1);
  EXPECT_GT(head["updates"], 0);
  EXPECT_GT(head["drift"], 0.0);
  EXPECT_EQ(head["paused"], false);
  EXPECT_GT(head["base"].size(), 0u);
  EXPECT_EQ(head["delta"].size(), head["base"].size());
  EXPECT_EQ(AdminJson("head", {policy}).count("base"), 0u);

  const auto promoted = AdminJson("promote_head", {policy});
  EXPECT_EQ(promoted["version"], 2);
  EXPECT_TRUE(std::filesystem::exists(promoted["path"].get<std::string>()));
  const auto listed = ParseOutput(Spikectl("policies", {"--json"}))["policies"];
  EXPECT_TRUE(std::any_of(listed.begin(), listed.end(), [](const auto& served) {
    return served["name"] == "cartpole-v1" && served["version"] == 2;
  }));

  EXPECT_EQ(AdminJson("reset_head", {policy, "--version=1"})["drift"], head["drift"]);
  EXPECT_EQ(AdminJson("head", {policy, "--version=1"})["drift"], 0.0);
}

TEST_F(SpikectlAdminTest, LearningIsPausedAndResumed) {
  const std::string policy = "--policy=cartpole-v1";
  EXPECT_EQ(AdminJson("pause_learning", {policy})["paused"], true);
  EXPECT_THAT(Admin("head", {policy}).output, HasSubstr("learning is paused"));
  EXPECT_EQ(AdminJson("head", {"--policy=pendulum-v1"})["paused"], false);
  AdminJson("pause_learning", {});
  EXPECT_EQ(AdminJson("head", {"--policy=pendulum-v1"})["paused"], true);
  EXPECT_THAT(Admin("resume_learning", {}).output, HasSubstr("every policy: learning resumed"));
  EXPECT_EQ(AdminJson("head", {policy})["paused"], false);
}

TEST_F(SpikectlAdminTest, MistakesAreNamed) {
  ExpectOneLineError(Admin("fly", {}), "expected one of load, unload");
  ExpectOneLineError(Admin("load", {}), "--policy: expected a name");
  ExpectOneLineError(Admin("promote_head", {}), "--policy: expected a name");
  ExpectOneLineError(Admin("pause_learning", {"--policy=nobody"}), "NOT_FOUND");
  ExpectOneLineError(Admin("traffic", {"--policy=pendulum-v1"}), "--shares: expected shares, none");
  ExpectOneLineError(Admin("rollout", {"--policy=pendulum-v1", "--steps=few"}),
                     "--steps: expected percentages such as 1,10,50,100, received \"few\"");
  ExpectOneLineError(Admin("rollout", {"--policy=pendulum-v1", "--abort_if=returns"}),
                     "--abort_if: expected return, errors or p99");
  ExpectOneLineError(Admin("traffic", {"--policy=pendulum-v1", "--shares=1"}),
                     "--shares: expected VERSION:PERCENT");
  ExpectOneLineError(Admin("load", {"--policy=pendulum-v1", "--version=9"}), "NOT_FOUND");
}

}  // namespace
}  // namespace spikeserve
