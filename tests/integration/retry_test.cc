// Tests that a repeated request gets the same bytes, on any connection.
#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

class RetryTest : public ServerTest {};

TEST_F(RetryTest, ARepeatedStepGetsTheSameBytes) {
  for (const std::string policy : {"discrete", "box"}) {
    const std::string session = client_->Open(policy);
    for (int64_t step = 0; step < 12; ++step) {
      const std::string answer = client_->Act(session, step).SerializeAsString();
      EXPECT_EQ(client_->Act(session, step).SerializeAsString(), answer) << step;
    }
  }
}

TEST_F(RetryTest, AStepWithAnotherContentIsNoRepetition) {
  const std::string session = client_->Open();
  client_->Act(session, 0);
  v1::ActRequest request;
  request.set_session_id(session);
  ExpectError(client_->TryAct(request), grpc::StatusCode::FAILED_PRECONDITION,
              "observation: expected");
}

TEST_F(RetryTest, AnAgentThatComesBackOnANewConnectionGoesOn) {
  const std::string session = client_->Open();
  client_->Act(session, 0);
  const std::string answer = client_->Act(session, 1).SerializeAsString();

  client_ = std::make_unique<TestClient>(server_->grpc_address());
  EXPECT_EQ(client_->Act(session, 1).SerializeAsString(), answer);
  auto context = NewContext();
  const auto stream = client_->stub().ActStream(context.get());
  v1::ActResponse response;
  ASSERT_TRUE(stream->Write(MakeActRequest(session, 1)) && stream->Read(&response));
  EXPECT_EQ(response.SerializeAsString(), answer);
  ASSERT_TRUE(stream->Write(MakeActRequest(session, 2)) && stream->Read(&response));
  EXPECT_EQ(response.step(), 2);
}

TEST_F(RetryTest, ARepeatedEndGetsTheSameBytesAndCountsOnce) {
  v1::OpenSessionRequest open;
  open.set_policy("discrete");
  open.set_action_selection(v1::SAMPLE);
  open.mutable_learning()->set_rule("policy_gradient");
  v1::OpenSessionResponse opened;
  ASSERT_TRUE(client_->stub().OpenSession(NewContext().get(), open, &opened).ok());
  const std::string& session = opened.session_id();
  for (int64_t step = 0; step < 4; ++step) client_->Act(session, step);
  v1::EndEpisodeRequest end;
  end.set_session_id(session);
  end.set_reward(2.0);
  end.set_terminated(true);
  end.set_target_return(7.0);
  std::vector<std::string> answers;
  for (int attempt = 0; attempt < 3; ++attempt) {
    v1::EndEpisodeResponse response;
    const auto status = client_->stub().EndEpisode(NewContext().get(), end, &response);
    ASSERT_TRUE(status.ok()) << status.error_message();
    EXPECT_EQ(response.steps(), 4);
    EXPECT_EQ(response.learning().updates(), 1);
    answers.push_back(response.SerializeAsString());
    client_ = std::make_unique<TestClient>(server_->grpc_address());
  }
  EXPECT_THAT(answers, ::testing::Each(answers.front()));
  EXPECT_EQ(Metric("spikeserve_episodes_total"), 1.0);
  EXPECT_EQ(Metric("spikeserve_learning_updates_total"), 1.0);
  v1::GetSessionRequest request;
  request.set_session_id(session);
  v1::GetSessionResponse state;
  ASSERT_TRUE(client_->stub().GetSession(NewContext().get(), request, &state).ok());
  EXPECT_EQ(state.episode(), 1);
  EXPECT_EQ(state.target_return(), 7.0);

  client_->Act(session, 0);  // the following end belongs to the next episode
  EXPECT_EQ(client_->EndEpisode(session, 2.0).steps(), 1);
  EXPECT_EQ(Metric("spikeserve_episodes_total"), 2.0);
}

TEST_F(RetryTest, RetriesCountOnce) {
  const std::string session = client_->Open();
  for (int64_t step = 0; step < 5; ++step) {
    client_->Act(session, step);
    client_->Act(session, step);
  }
  EXPECT_EQ(Metric("spikeserve_decisions_total"), 5.0);
  v1::GetSessionRequest request;
  request.set_session_id(session);
  v1::GetSessionResponse response;
  ASSERT_TRUE(client_->stub().GetSession(NewContext().get(), request, &response).ok());
  EXPECT_EQ(response.decisions(), 5u);
  EXPECT_DOUBLE_EQ(response.episode_return(), 0.1 + 0.2 + 0.0 + 0.1);
}

}  // namespace
}  // namespace spikeserve
