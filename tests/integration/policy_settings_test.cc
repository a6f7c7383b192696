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
  std::vector<std::pair<std::string, std::string>> mistakes = {
      {"{", "settings: "},
      {R"({"policy": {}})", "expected no other keys, received \"policy\""},
      {R"({"unloaded": {"p": 1}})", "unloaded.p: expected an array"},
      {R"({"unloaded": {"p": [0]}})", "unloaded.p: expected an integer of at least 1"}};
  const std::pair<const char*, const char*> of_a_policy[] = {
      {"[]", "policies.p: expected an object, received an array of 0"},
      {R"({"defualt_version": 1})", "policies.p: expected no other keys, received \"defualt_"},
      {R"({"default_version": 0})", "policies.p.default_version: expected an integer of at least"},
      {R"({"default_version": "1"})", "policies.p.default_version: expected an integer of at"},
      {R"({"default_version": 1, "default_follows_highest": true})",
       "policies.p.default_version: expected none beside default_follows_highest, received 1"},
      {R"({"shadow_version": 1.5})", "policies.p.shadow_version: expected an integer of at least"},
      {R"({"learning_paused": 1})", "policies.p.learning_paused: expected true or false"},
      {R"({"labels": {"a b": 1}})", "policies.p.labels: expected letters, digits"},
      {R"({"labels": {"a": -1}})", "policies.p.labels.a: expected an integer of at least 1"},
      {R"({"shares": {}})", "policies.p.shares: expected an array, received an object"},
      {R"({"shares": [{"version": 1, "percent": 101}]})",
       "policies.p.shares[0].percent: expected an integer from 0 to 100, received 101"},
      {R"({"shares": [{"version": 1, "percent": 60}]})",
       "policies.p.shares: expected percents that add up to 100, received 60"},
      {R"({"shares": [{"version": 1, "percent": 50}, {"version": 1, "percent": 50}]})",
       "policies.p.shares: expected each version once, received 1 twice"}};
  for (const auto& [policy, message] : of_a_policy) {
    mistakes.emplace_back(absl::StrCat("{\"policies\": {\"p\": ", policy, "}}"), message);
  }
  for (const auto& [text, message] : mistakes) {
    std::ofstream(file_) << text;
    const auto server =
        ServerProcess::Start(policies_.path().string(), {"--policy_settings=" + file_.string()});
    ASSERT_FALSE(server.ok()) << text;
    EXPECT_THAT(std::string(server.status().message()),
                HasSubstr("--policy_settings: " + file_.string() + ": "));
    EXPECT_THAT(std::string(server.status().message()), HasSubstr(message));
  }
}

}  // namespace
}  // namespace spikeserve
