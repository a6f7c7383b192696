// Tests of an operator's changes to the served policies while agents play, with real processes.
#include <atomic>
#include <fstream>
#include <map>
#include <set>
#include <thread>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/barrier.h"
#include "grpc/health/v1/health.grpc.pb.h"
#include "tests/integration/policy_admin_fixture.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::UnorderedElementsAre;

TEST_F(PolicyAdminTest, NewSessionsGetTheNewVersionAndRunningOnesKeepTheirs) {
  const std::string old_session = client_->Open();
  const v1::ActResponse first = client_->Act(old_session, 0);
  AddVersion(3);
  ASSERT_TRUE(TryLoad(3, /*make_default=*/true).ok());
  EXPECT_EQ(DefaultVersion(), 3);
  ASSERT_TRUE(TryUnload(2).ok());

  // The session continues as on a server on which nothing changed.
  const std::string twin = [&] {
    EXPECT_TRUE(TryLoad(2).ok());
    v1::OpenSessionRequest request;
    request.set_policy("discrete");
    request.set_version(2);
    v1::OpenSessionResponse response;
    EXPECT_TRUE(client_->stub().OpenSession(NewContext().get(), request, &response).ok());
    return response.session_id();
  }();
  EXPECT_THAT(client_->Act(twin, 0).action_probabilities(),
              ::testing::ElementsAreArray(first.action_probabilities()));
  for (int64_t step = 1; step < 10; ++step) {
    EXPECT_THAT(client_->Act(old_session, step).action_probabilities(),
                ::testing::ElementsAreArray(client_->Act(twin, step).action_probabilities()));
  }
}

TEST_F(PolicyAdminTest, ReloadLoadsNewFilesAndDropsThoseThatAreGone) {
  AddVersion(3);
  std::filesystem::remove_all(FileOf(1).parent_path());
  const auto report = Reload();
  ASSERT_EQ(report.loaded_size(), 1);
  EXPECT_EQ(report.loaded(0).version(), 3);
  ASSERT_EQ(report.unloaded_size(), 1);
  EXPECT_EQ(report.unloaded(0).version(), 1);
  EXPECT_THAT(Versions(), ElementsAre(2, 3));
  EXPECT_EQ(Reload().loaded_size(), 0);
}

TEST_F(PolicyAdminTest, ABadFileNeverTakesAGoodOneDown) {
  const std::string session = client_->Open();
  client_->Act(session, 0);
  std::ofstream(FileOf(2), std::ios::binary) << "garbage";
  const auto report = Reload();
  ASSERT_EQ(report.refused_size(), 1);
  EXPECT_THAT(report.refused(0), HasSubstr(FileOf(2).string()));
  ExpectError(TryLoad(2), grpc::StatusCode::INVALID_ARGUMENT, FileOf(2).string());
  EXPECT_EQ(DefaultVersion(), 2);
  client_->Act(session, 1);

  AddVersion(2);  // a valid file again
  EXPECT_EQ(Reload().refused_size(), 0);
}

TEST_F(PolicyAdminTest, APolledDirectoryNeedsNoOperator) {
  StartServer({"--poll_policies=10ms"});
  const auto garbage = policies_.path() / "garbage";
  std::ofstream(garbage, std::ios::binary) << "garbage";
  // Renamed into place, so that the server cannot refuse a half-written file as well.
  std::filesystem::rename(garbage, FileOf(1));
  AddVersion(4);
  while (Versions() != std::vector<int64_t>{1, 2, 4}) {
  }
  std::filesystem::remove_all(FileOf(4).parent_path());
  while (Versions() != std::vector<int64_t>{1, 2}) {
  }
  EXPECT_EQ(server_->Stop(), 0);
  EXPECT_THAT(server_->Log(), HasSubstr(" info policy loaded policy=\"discrete/4\"\n"));
  EXPECT_THAT(server_->Log(), HasSubstr(" info policy unloaded policy=\"discrete/4\"\n"));
  const std::string log = server_->Log();
  // Only the lines about version 1 count: the server may also refuse version 4 if it finds its
  // directory before its file is there.
  const std::string line = "policy refused error=\"" + FileOf(1).string();
  const size_t refusal = log.find(line);
  EXPECT_NE(refusal, std::string::npos);
  EXPECT_EQ(log.find(line, refusal + 1), std::string::npos) << "logged once: " << log;
}

TEST_F(PolicyAdminTest, AVersionThatIsInUseStays) {
  SetDefault(1);
  EXPECT_EQ(DefaultVersion(), 1);
  ExpectError(TryUnload(1), grpc::StatusCode::FAILED_PRECONDITION, "which is the default");
  SetDefault(0);
  EXPECT_EQ(DefaultVersion(), 2);
  SetLabel("stable", 1);
  ExpectError(TryUnload(1), grpc::StatusCode::FAILED_PRECONDITION, "label stable");
  std::filesystem::remove_all(FileOf(1).parent_path());
  EXPECT_THAT(Reload().refused(), ElementsAre(HasSubstr("the file is gone")));
  EXPECT_THAT(Versions(), ElementsAre(1, 2));
  ExpectError(TryUnload(7), grpc::StatusCode::NOT_FOUND, "received 7");
}

TEST_F(PolicyAdminTest, AnUnloadedVersionStaysAwayUntilItIsLoaded) {
  ASSERT_TRUE(TryUnload(1).ok());
  EXPECT_EQ(Reload().loaded_size(), 0);
  EXPECT_THAT(Versions(), ElementsAre(2));
  ASSERT_TRUE(TryLoad(1).ok());
  EXPECT_THAT(Versions(), ElementsAre(1, 2));
  EXPECT_EQ(DefaultVersion(), 2);
}

TEST_F(PolicyAdminTest, TheDefaultIsUnloadedLast) {
  ExpectError(TryUnload(2), grpc::StatusCode::FAILED_PRECONDITION, "which is the default");
  ASSERT_TRUE(TryUnload(1).ok());
  ASSERT_TRUE(TryUnload(2).ok());
  EXPECT_THAT(Versions(), ElementsAre());
  ASSERT_TRUE(TryLoad(1).ok());
  EXPECT_EQ(DefaultVersion(), 1);
  ASSERT_TRUE(TryLoad(2).ok());
  EXPECT_EQ(DefaultVersion(), 1);
}

TEST_F(PolicyAdminTest, LabelsNameVersions) {
  SetLabel("stable", 1);
  SetLabel("canary", 2);
  EXPECT_EQ(Open("stable").version(), 1);
  EXPECT_EQ(Open("canary").version(), 2);
  SetLabel("stable", 2);
  EXPECT_EQ(Open("stable").version(), 2);

  v1::OpenSessionRequest request;
  request.set_policy("discrete");
  request.set_version_label("beta");
  ExpectError(client_->TryOpen(request), grpc::StatusCode::NOT_FOUND, "canary, stable");
  request.set_version(1);
  ExpectError(client_->TryOpen(request), grpc::StatusCode::INVALID_ARGUMENT, "version_label");
}

TEST_F(PolicyAdminTest, TrafficIsDividedByKey) {
  Must(&v1::PolicyAdmin::Stub::SetTraffic, Traffic({{1, 80}, {2, 20}}));
  std::map<int64_t, int> sessions;
  for (int robot = 0; robot < 500; ++robot) {
    const std::string key = absl::StrCat("robot-", robot);
    const int64_t version = Open("", key).version();
    ++sessions[version];
    if (robot >= 20) continue;
    EXPECT_EQ(Open("", key).version(), version) << key;
  }
  // The hash determines these counts, so they are the same in every run. With the right shares they
  // are within 40 of the expected values.
  EXPECT_NEAR(sessions[1], 400, 40);
  EXPECT_NEAR(sessions[2], 100, 40);

  v1::SetTrafficResponse ignored;
  ExpectError(admin_->SetTraffic(NewContext().get(), Traffic({{1, 80}, {2, 30}}), &ignored),
              grpc::StatusCode::INVALID_ARGUMENT, "add up to 100, received 110");
  ExpectError(admin_->SetTraffic(NewContext().get(), Traffic({{1, 80}, {9, 20}}), &ignored),
              grpc::StatusCode::NOT_FOUND, "received 9");
  Must(&v1::PolicyAdmin::Stub::SetTraffic, Traffic({}));
  EXPECT_EQ(DefaultVersion(), 2);
}

TEST_F(PolicyAdminTest, AShadowSeesTheTrafficAndAnswersNobody) {
  // Version 3 is a copy of version 2; version 1 is a different policy.
  std::filesystem::create_directories(FileOf(3).parent_path());
  std::filesystem::copy_file(FileOf(2), FileOf(3));
  ASSERT_TRUE(TryLoad(3).ok());
  SetDefault(2);
  const std::string plain = client_->Open();
  Must(&v1::PolicyAdmin::Stub::SetTraffic, Traffic({}, /*shadow=*/3));
  const std::string twin = client_->Open();
  Must(&v1::PolicyAdmin::Stub::SetTraffic, Traffic({}, /*shadow=*/1));
  const std::string other = client_->Open();
  constexpr int kEpisodes = 2;
  constexpr int kSteps = 25;
  for (int episode = 0; episode < kEpisodes; ++episode) {
    for (int64_t step = 0; step < kSteps; ++step) {
      const auto expected = client_->Act(plain, step).action_probabilities();
      EXPECT_THAT(client_->Act(twin, step).action_probabilities(),
                  ::testing::ElementsAreArray(expected));
      client_->Act(twin, step);  // a retry is not shadowed again
      EXPECT_THAT(client_->Act(other, step).action_probabilities(),
                  ::testing::ElementsAreArray(expected));
    }
    for (const std::string& session : {plain, twin, other}) client_->EndEpisode(session, 1.0);
  }

  const std::string metric = "spikeserve_shadow_decisions_total";
  while (Metric(metric) < 2 * kEpisodes * kSteps) {
  }
  EXPECT_EQ(Metric(metric), 2 * kEpisodes * kSteps);
  EXPECT_EQ(Metric(metric, {"shadow_version=\"3\"", "agreement=\"agree\""}), kEpisodes * kSteps);
  EXPECT_GT(Metric(metric, {"shadow_version=\"1\"", "agreement=\"differ\""}), 0);
  EXPECT_EQ(Metric("spikeserve_shadow_spikes_total", {"shadow_version=\"3\"", "side=\"served\""}),
            Metric("spikeserve_shadow_spikes_total", {"shadow_version=\"3\"", "side=\"shadow\""}));
  EXPECT_EQ(Metric("spikeserve_decisions_total"), 3 * kEpisodes * kSteps);
  EXPECT_EQ(Metric("spikeserve_shadow_dropped_total"), 0);
}

TEST_F(PolicyAdminTest, SessionsAreListedByPages) {
  std::set<std::string> opened;
  for (int i = 0; i < 5; ++i) opened.insert(client_->Open());
  const std::string other = client_->Open("box");
  client_->Act(other, 0);

  std::set<std::string> listed;
  v1::ListSessionsRequest request;
  request.set_policy("discrete");
  request.set_page_size(2);
  int pages = 0;
  do {
    const auto page = Must(&v1::PolicyAdmin::Stub::ListSessions, request);
    for (const auto& session : page.sessions()) listed.insert(session.session_id());
    EXPECT_EQ(page.open_sessions(), 6);
    request.set_page_token(page.next_page_token());
    ++pages;
  } while (!request.page_token().empty());
  EXPECT_EQ(pages, 3);
  EXPECT_EQ(listed, opened);

  request.set_policy("box");
  const auto page = Must(&v1::PolicyAdmin::Stub::ListSessions, request);
  ASSERT_EQ(page.sessions_size(), 1);
  EXPECT_EQ(page.sessions(0).session_id(), other);
  EXPECT_EQ(page.sessions(0).step(), 1);
  EXPECT_GT(page.sessions(0).spikes(), 0u);
}

TEST_F(PolicyAdminTest, ADrainingServerFinishesWhatItHas) {
  using grpc::health::v1::HealthCheckResponse;
  const std::string session = client_->Open();
  const auto drained = Must(&v1::PolicyAdmin::Stub::Drain, v1::DrainRequest());
  EXPECT_EQ(drained.open_sessions(), 1);
  EXPECT_EQ(Health(""), HealthCheckResponse::NOT_SERVING);
  EXPECT_EQ(Health("spikeserve.v1.PolicyService"), HealthCheckResponse::NOT_SERVING);
  EXPECT_EQ(Health("spikeserve.v1.PolicyAdmin"), HealthCheckResponse::SERVING);
  EXPECT_EQ(Page("/healthz"), "NOT_SERVING\n");
  v1::OpenSessionRequest request;
  request.set_policy("discrete");
  ExpectError(client_->TryOpen(request), grpc::StatusCode::UNAVAILABLE, "draining");
  client_->Act(session, 0);

  v1::DrainRequest cancel;
  cancel.set_cancel(true);
  Must(&v1::PolicyAdmin::Stub::Drain, cancel);
  EXPECT_EQ(Health(""), HealthCheckResponse::SERVING);
  client_->Open();
}

// Plays a session on a stream of its own until `stop` and returns the number of answers.
int64_t PlayStream(TestClient& client, const std::string& session, const std::atomic<bool>& stop) {
  auto context = NewContext();
  const auto stream = client.stub().ActStream(context.get());
  int64_t step = 0;
  for (; !stop; ++step) {
    v1::ActResponse response;
    EXPECT_TRUE(stream->Write(MakeActRequest(session, step)));
    EXPECT_TRUE(stream->Read(&response));
    EXPECT_FALSE(response.has_error()) << response.error().message();
    EXPECT_EQ(response.step(), step);
    if (::testing::Test::HasFailure()) break;
  }
  stream->WritesDone();
  EXPECT_TRUE(stream->Finish().ok());
  return step;
}

TEST_F(PolicyAdminTest, ASwapUnder64RunningStreamsLosesNoCallAndNoSession) {
  constexpr int kStreams = 64;
  std::vector<std::string> sessions;
  for (int i = 0; i < kStreams; ++i) sessions.push_back(client_->Open());
  std::atomic<bool> stop = false;
  std::atomic<int64_t> answers = 0;
  std::vector<std::thread> agents;
  for (const std::string& session : sessions) {
    agents.emplace_back([&, session] { answers += PlayStream(*client_, session, stop); });
  }
  for (int version = 3; version < 13; ++version) {
    AddVersion(version);
    ASSERT_TRUE(TryLoad(version, /*make_default=*/true).ok());
    EXPECT_EQ(DefaultVersion(), version);
    ASSERT_TRUE(TryUnload(version - 1).ok());
    const double before = Metric("spikeserve_decisions_total");
    while (Metric("spikeserve_decisions_total") < before + kStreams) {
    }
  }
  stop = true;
  for (std::thread& agent : agents) agent.join();

  EXPECT_EQ(Metric("spikeserve_decisions_total"), static_cast<double>(answers));
  EXPECT_EQ(Metric("spikeserve_sessions", {"policy=\"discrete\"", "version=\"2\""}), kStreams);
  for (const std::string& session : sessions) {
    v1::GetSessionRequest request;
    request.set_session_id(session);
    v1::GetSessionResponse response;
    ASSERT_TRUE(client_->stub().GetSession(NewContext().get(), request, &response).ok());
    EXPECT_EQ(response.version(), 2);
    EXPECT_GT(response.step(), 0);
  }
}

}  // namespace
}  // namespace spikeserve
