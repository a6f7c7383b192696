#include "spikeserve/remote_session.h"

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

class RemoteSessionTest : public ::testing::Test {
 protected:
  RemoteSessionTest() {
    ClientOptions options;
    options.retry.max_attempts = 2;
    options.retry.sleep = [](absl::Duration) {};
    client_ = *Client::Create(fake_.channel(), options);
  }

  RemoteSession Open() { return {client_.get(), client_->OpenSession({})->session_id(), 0}; }

  FakePolicyService fake_;
  std::unique_ptr<Client> client_;
  const std::vector<float> observation_ = {0.5f, -1.0f};
};

TEST_F(RemoteSessionTest, CountsItsSteps) {
  RemoteSession session = Open();
  for (int step = 0; step < 3; ++step) {
    EXPECT_EQ(session.step(), step);
    const auto answer = session.Act(observation_, 1.0);
    ASSERT_TRUE(answer.ok()) << answer.status();
    EXPECT_EQ(answer->step(), step);
  }
  EXPECT_EQ(fake_.decisions(), 3);
}

TEST_F(RemoteSessionTest, TheStepMovesOnlyWithAnAnswer) {
  RemoteSession session = Open();
  ASSERT_TRUE(session.Act(observation_, 0.0).ok());
  fake_.LoseNextReplies(2);
  EXPECT_TRUE(absl::IsUnavailable(session.Act(observation_, 1.0).status()));
  EXPECT_EQ(session.step(), 1);
  const auto answer = session.Act(observation_, 1.0);
  ASSERT_TRUE(answer.ok()) << answer.status();
  EXPECT_EQ(answer->step(), 1);
  EXPECT_EQ(fake_.decisions(), 2);
}

TEST_F(RemoteSessionTest, ARestartedAgentGetsItsLastAnswerAgain) {
  RemoteSession before = Open();
  ASSERT_TRUE(before.Act(observation_, 0.0).ok());
  const auto last = before.Act(observation_, 1.0);
  ASSERT_TRUE(last.ok()) << last.status();

  RemoteSession after(client_.get(), before.session_id(), last->step());
  const auto again = after.Act(observation_, 1.0);
  ASSERT_TRUE(again.ok()) << again.status();
  EXPECT_EQ(again->SerializeAsString(), last->SerializeAsString());
  EXPECT_EQ(after.Act(observation_, 1.0)->step(), 2);
}

TEST_F(RemoteSessionTest, MakesTheRequestOfItsStep) {
  const RemoteSession session(client_.get(), "mine", 4);
  const v1::ActRequest request = session.MakeRequest(observation_, -0.25);
  EXPECT_EQ(request.session_id(), "mine");
  EXPECT_EQ(request.step(), 4);
  EXPECT_THAT(request.observation(), ElementsAre(0.5f, -1.0f));
  EXPECT_EQ(request.reward(), -0.25);
}

TEST_F(RemoteSessionTest, RefusesTheAnswerToSomethingElse) {
  RemoteSession session(client_.get(), "mine", 4);
  v1::ActResponse response;
  response.set_session_id("mine");
  response.set_step(3);
  const absl::Status wrong_step = session.Accept(response);
  EXPECT_TRUE(absl::IsInternal(wrong_step));
  EXPECT_THAT(wrong_step.message(), HasSubstr("step 4 of session mine"));
  response.set_session_id("yours");
  response.set_step(4);
  EXPECT_TRUE(absl::IsInternal(session.Accept(response)));
  EXPECT_EQ(session.step(), 4);
}

TEST_F(RemoteSessionTest, EndEpisodeStartsTheNextAtStepZero) {
  RemoteSession session = Open();
  ASSERT_TRUE(session.Act(observation_, 0.0).ok());
  const auto end = session.EndEpisode(
      {.reward = 1.5, .terminated = true, .truncated = false, .target_return = 200.0});
  ASSERT_TRUE(end.ok()) << end.status();
  EXPECT_EQ(end->steps(), 1);
  EXPECT_EQ(session.step(), 0);
  EXPECT_TRUE(session.Act(observation_, 0.0).ok());

  const v1::EndEpisodeRequest sent = fake_.last_end_episode();
  EXPECT_EQ(sent.reward(), 1.5);
  EXPECT_TRUE(sent.terminated());
  EXPECT_FALSE(sent.truncated());
  EXPECT_EQ(sent.target_return(), 200.0);
}

TEST_F(RemoteSessionTest, AnUnsetTargetReturnIsNotSent) {
  RemoteSession session = Open();
  ASSERT_TRUE(session.EndEpisode({.reward = 0.0, .truncated = true}).ok());
  EXPECT_FALSE(fake_.last_end_episode().has_target_return());
}

TEST_F(RemoteSessionTest, CloseFreesTheSession) {
  RemoteSession session = Open();
  EXPECT_TRUE(session.Close().ok());
  EXPECT_EQ(fake_.sessions(), 0);
}

}  // namespace
}  // namespace spikeserve
