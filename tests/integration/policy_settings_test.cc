// Tests that an operator's settings persist over restarts of a real server.
#include <fstream>

#include "tests/integration/policy_admin_fixture.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

// Returns a text with the operator's settings of a version, from the answer of ListPolicies.
std::string SettingsOf(const v1::PolicyInfo& policy) {
  std::string labels;
  for (const std::string& label : policy.version_labels()) absl::StrAppend(&labels, " ", label);
  return absl::StrCat(policy.version(), policy.is_default() ? " default" : "", labels, " ",
                      policy.traffic_percent(), "%", policy.is_shadow() ? " shadow" : "");
}

class PolicySettingsTest : public PolicyAdminTest {
 protected:
  // Stops the server and starts it with the same file of settings.
  void Restart() {
    ASSERT_EQ(server_->Stop(), 0);
    StartServer({"--policy_settings=" + file_.string()});
    Connect();
  }

  std::vector<std::string> Held() {
    v1::ListPoliciesResponse list;
    EXPECT_TRUE(client_->stub().ListPolicies(NewContext().get(), {}, &list).ok());
    std::vector<std::string> lines;
    for (const auto& policy : list.policies()) {
      if (policy.name() == "discrete") lines.push_back(SettingsOf(policy));
    }
    return lines;
  }

  bool Paused(const std::string& policy, int version) {
    v1::GetHeadRequest request;
    request.set_policy(policy);
    request.set_version(version);
    return Must(&v1::PolicyAdmin::Stub::GetHead, request).paused();
  }

  TemporaryDirectory kept_;
  const std::filesystem::path file_ = kept_.path() / "settings.json";
};

TEST_F(PolicySettingsTest, SettingsOutliveTheServer) {
  for (const int version : {3, 4}) AddVersion(version);
  Restart();
  SetDefault(1);
  SetLabel("stable", 1);
  SetLabel("canary", 2);
  Must(&v1::PolicyAdmin::Stub::SetTraffic, Traffic({{1, 80}, {2, 20}}, /*shadow=*/3));
  ASSERT_TRUE(TryUnload(4).ok());
  const auto before = Held();
  EXPECT_THAT(before, ElementsAre("1 default stable 80%", "2 canary 20%", "3 0% shadow"));
  std::map<std::string, int64_t> routes;
  for (int robot = 0; robot < 20; ++robot) {
    const std::string key = absl::StrCat("robot-", robot);
    routes[key] = Open("", key).version();
  }

  Restart();
  EXPECT_EQ(Held(), before);
  for (const auto& [key, version] : routes) EXPECT_EQ(Open("", key).version(), version) << key;
  ASSERT_TRUE(TryLoad(4).ok());  // cancels the unload for all later restarts
  Restart();
  EXPECT_EQ(Held().size(), 4u);
}

TEST_F(PolicySettingsTest, AFileThatCannotBeWrittenStopsTheStart) {
  // Not even a superuser can create files in /proc.
  for (const std::string& path : {(kept_.path() / "no such folder" / "settings.json").string(),
                                  std::string("/proc/settings.json")}) {
    const auto server =
        ServerProcess::Start(policies_.path().string(), {"--policy_settings=" + path});
    ASSERT_FALSE(server.ok()) << path;
    EXPECT_THAT(std::string(server.status().message()),
                HasSubstr("--policy_settings: expected a file in a directory that the server can "
                          "write: " +
                          path));
  }
}

TEST_F(PolicySettingsTest, WhatCannotBeWrittenDownIsNotSet) {
  const auto folder = kept_.path() / "folder";
  std::filesystem::create_directory(folder);
  const std::string path = (folder / "settings.json").string();
  StartServer({"--policy_settings=" + path});
  Connect();
  std::filesystem::remove_all(folder);
  v1::SetDefaultVersionRequest request;
  request.set_policy("discrete");
  request.set_version(1);
  v1::SetDefaultVersionResponse response;
  const auto status = admin_->SetDefaultVersion(NewContext().get(), request, &response);
  EXPECT_FALSE(status.ok());
  EXPECT_THAT(status.error_message(), HasSubstr(path));
  EXPECT_FALSE(TryUnload(1).ok());
  EXPECT_THAT(Versions(), ElementsAre(1, 2));
  EXPECT_EQ(DefaultVersion(), 2);
}

TEST_F(PolicySettingsTest, ASettingWaitsForAVersionThatIsNotThere) {
  AddVersion(3);
  Restart();
  SetDefault(2);
  SetLabel("stable", 1);
  SetLabel("canary", 2);
  Must(&v1::PolicyAdmin::Stub::SetTraffic, Traffic({{1, 80}, {2, 20}}, /*shadow=*/2));
  const auto before = Held();
  const auto away = kept_.path() / "away";
  std::filesystem::rename(FileOf(2).parent_path(), away);
  Restart();
  EXPECT_THAT(Held(), ElementsAre("1 stable 0%", "3 default 0%"));
  const std::string waits = ": waits for version 2, which is not served";
  for (const std::string setting : {"default_version", "labels.canary", "shares"}) {
    EXPECT_THAT(server_->Log(), HasSubstr(" warning setting pending setting=\"" + file_.string() +
                                          ": policies.discrete." + setting + waits));
  }
  EXPECT_EQ(Reload().waiting_size(), 4);

  // A setting made in the meantime does not discard the waiting ones, not even over another
  // restart.
  SetLabel("stable", 3);
  Restart();
  std::filesystem::rename(away, FileOf(2).parent_path());
  EXPECT_EQ(Reload().waiting_size(), 0);
  EXPECT_THAT(Held(), ElementsAre("1 80%", "2 default canary 20% shadow", "3 stable 0%"));
}

TEST_F(PolicySettingsTest, ASettingWaitsForAPolicyThatIsNotThere) {
  Restart();
  SetLabel("stable", 1);
  const auto folder = policies_.path() / "discrete";
  std::filesystem::rename(folder, kept_.path() / "away");
  Restart();
  EXPECT_TRUE(Versions().empty());
  Restart();
  std::filesystem::rename(kept_.path() / "away", folder);
  ASSERT_TRUE(TryLoad(1).ok());
  EXPECT_THAT(Held(), ElementsAre("1 default stable 0%"));
}

TEST_F(PolicySettingsTest, AServerWhoseLastVersionWasUnloadedStartsAgain) {
  const auto box = policies_.path() / "box";
  std::filesystem::remove_all(box);
  Restart();
  ASSERT_TRUE(TryUnload(1).ok());
  ASSERT_TRUE(TryUnload(2).ok());
  Restart();
  EXPECT_TRUE(Versions().empty());
}

TEST_F(PolicySettingsTest, APauseOutlivesTheServer) {
  Restart();
  v1::PauseLearningRequest pause;
  pause.set_policy("discrete");
  Must(&v1::PolicyAdmin::Stub::PauseLearning, pause);
  AddVersion(3);
  Restart();
  for (const int version : {1, 2, 3}) EXPECT_TRUE(Paused("discrete", version)) << version;
  EXPECT_FALSE(Paused("box", 1));
  v1::ResumeLearningRequest resume;
  Must(&v1::PolicyAdmin::Stub::ResumeLearning, resume);
  Restart();
  EXPECT_FALSE(Paused("discrete", 1));
}

TEST_F(PolicySettingsTest, AMistakeInTheFileKeepsTheServerFromStarting) {
  const std::pair<const char*, const char*> mistakes[] = {
      {R"({"policies": {"a": {"learning_paused": 1}}})",
       "policies.a.learning_paused: expected true or false"},
      {R"({"policies": {"a": {"default_version": 0}}})",
       "policies.a.default_version: expected an integer of at least 1"},
      {R"({"policies": {"a": {"labels": {"a b": 1}}}})", "policies.a.labels: expected letters"},
      {R"({"policies": {"a": {"shares": [{"version": 1, "percent": 90}]}}})",
       "policies.a.shares: expected percents that add up to 100, received 90"},
      {R"({"policy": {}})", "policy"},
  };
  for (const auto& [text, message] : mistakes) {
    std::ofstream(file_) << text;
    const auto server =
        ServerProcess::Start(policies_.path().string(), {"--policy_settings=" + file_.string()});
    ASSERT_FALSE(server.ok()) << text;
    EXPECT_THAT(std::string(server.status().message()), HasSubstr(message));
  }
}

}  // namespace
}  // namespace spikeserve
