// Tests that a client that is killed in the middle of an episode loses no decision.
#include <csignal>

#include "absl/strings/str_split.h"
#include "core/base/hex.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"
#include "tests/integration/client_fixture.h"

namespace spikeserve {
namespace {

constexpr int kSteps = 25;  // many more than the context

// A request and its answer.
struct Exchanged {
  v1::ActRequest request;
  v1::ActResponse answer;
};

class ClientRestartTest : public ClientProgramTest {
 protected:
  // Starts an agent, kills it in the middle of its episode, and returns all its requests and
  // answers.
  std::vector<Exchanged> PlayAndKill() {
    auto agent = Subprocess::Start({CLIENT_STUCK_AGENT_PROGRAM, server_->grpc_address(),
                                    "cartpole-v1", std::to_string(kSteps)});
    EXPECT_TRUE(agent.ok()) << agent.status();
    std::vector<Exchanged> log;
    for (auto line = (*agent)->ReadLine(); line.has_value() && *line != "stuck";
         line = (*agent)->ReadLine()) {
      const std::vector<std::string> parts = absl::StrSplit(*line, ' ');
      Exchanged& exchanged = log.emplace_back();
      EXPECT_TRUE(exchanged.request.ParseFromString(ParseHex(parts.at(0)).value()));
      EXPECT_TRUE(exchanged.answer.ParseFromString(ParseHex(parts.at(1)).value()));
    }
    (*agent)->Signal(SIGKILL);
    EXPECT_EQ((*agent)->Wait(), 128 + SIGKILL);
    return log;
  }

  static absl::StatusOr<v1::ActResponse> Repeat(const v1::ActRequest& request,
                                                RemoteSession* session) {
    return session->Act(request.observation(), request.reward());
  }
};

TEST_F(ClientRestartTest, TheNextClientGetsTheLastAnswerAgainAndGoesOn) {
  const std::vector<Exchanged> log = PlayAndKill();
  ASSERT_EQ(log.size(), static_cast<size_t>(kSteps));
  const double decisions = Metric("spikeserve_decisions_total");
  const auto client = Client::Connect(server_->grpc_address());
  ASSERT_TRUE(client.ok()) << client.status();

  const Exchanged& last = log.back();
  RemoteSession session(client->get(), last.request.session_id(), last.request.step());
  const auto again = Repeat(last.request, &session);
  ASSERT_TRUE(again.ok()) << again.status();
  EXPECT_EQ(again->SerializeAsString(), last.answer.SerializeAsString());
  EXPECT_EQ(Metric("spikeserve_decisions_total"), decisions);

  // From here on a session that was never interrupted makes the same decisions.
  v1::OpenSessionRequest open;
  open.set_policy("cartpole-v1");
  RemoteSession control(client->get(), (*client)->OpenSession(open)->session_id(), 0);
  for (const Exchanged& exchanged : log) ASSERT_TRUE(Repeat(exchanged.request, &control).ok());
  const std::vector<float> observation = {0.1f, 0.2f, 0.3f, 0.4f};
  const auto interrupted = session.Act(observation, 1.0);
  const auto uninterrupted = control.Act(observation, 1.0);
  ASSERT_TRUE(interrupted.ok() && uninterrupted.ok());
  EXPECT_EQ(interrupted->step(), kSteps);
  EXPECT_EQ(interrupted->return_to_go(), uninterrupted->return_to_go());
  EXPECT_EQ(interrupted->stats().spikes(), uninterrupted->stats().spikes());
  EXPECT_EQ(interrupted->action_probabilities(0), uninterrupted->action_probabilities(0));
}

TEST_F(ClientRestartTest, AnOlderStepIsRefusedWithTheOneExpected) {
  const std::vector<Exchanged> log = PlayAndKill();
  ASSERT_EQ(log.size(), static_cast<size_t>(kSteps));
  const auto client = Client::Connect(server_->grpc_address());
  ASSERT_TRUE(client.ok()) << client.status();
  RemoteSession session(client->get(), log.front().request.session_id(), 3);
  const auto refused = Repeat(log[3].request, &session);
  EXPECT_TRUE(absl::IsFailedPrecondition(refused.status())) << refused.status();
  EXPECT_THAT(refused.status().message(), ::testing::HasSubstr(std::to_string(kSteps)));
}

}  // namespace
}  // namespace spikeserve
