#include "spikeserve/remote_session.h"

#include <set>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "google/protobuf/message.h"
#include "gtest/gtest.h"
#include "spikeserve/status.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

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

// Expects that every field of `message` is set, except those that are `handled` by the library.
void ExpectEveryFieldSet(const google::protobuf::Message& message,
                         const std::set<std::string>& handled) {
  std::vector<const google::protobuf::FieldDescriptor*> set;
  message.GetReflection()->ListFields(message, &set);
  std::set<std::string> names = handled;
  for (const auto* field : set) names.insert(std::string(field->name()));
  for (int i = 0; i < message.GetDescriptor()->field_count(); ++i) {
    const std::string name(message.GetDescriptor()->field(i)->name());
    EXPECT_EQ(names.count(name), 1u) << name << " cannot be set";
  }
}

TEST_F(RemoteSessionTest, EveryFieldOfTheContractCanBeSet) {
  v1::ActionSource source;
  source.set_kind(v1::ActionSource::OPERATOR);
  ExecutedAction executed({}, source);
  executed.action.set_discrete(1);
  RemoteSession session = Open();
  ASSERT_TRUE(session.Act(observation_, 0.0).ok());
  // The session counts its decisions and steps. The beats, and the ends of episodes behind them,
  // are those of a robot's pilot, which makes its own requests. A program that traces adds its
  // `traceparent` to what MakeRequest() returns.
  ExpectEveryFieldSet(session.MakeRequest(observation_, 1.0, executed),
                      {"decision", "history", "skipped_rewards", "observed_at", "valid_until",
                       "report", "traceparent", "end_episode"});
  ASSERT_TRUE(session
                  .EndEpisode({.reward = 1.0,
                               .terminated = true,
                               .truncated = true,
                               .target_return = 2.0,
                               .observation = observation_,
                               .executed_action = executed})
                  .ok());
  ExpectEveryFieldSet(fake_.last_end_episode(), {"episode", "steps"});
}

TEST_F(RemoteSessionTest, ALostSessionIsReplacedOnRequest) {
  auto session = RemoteSession::Open(client_.get(), {}, /*reopens=*/true);
  ASSERT_TRUE(session.ok()) << session.status();
  ASSERT_TRUE(session->Act(observation_, 0.0).ok());
  const std::string lost = session->session_id();
  ASSERT_TRUE(client_->CloseSession(lost).ok());
  const auto answer = session->Act(observation_, 1.0);
  ASSERT_TRUE(answer.ok()) << answer.status();
  EXPECT_EQ(answer->step(), 0);
  EXPECT_NE(session->session_id(), lost);
  EXPECT_EQ(session->reopened(), 1);
  // The totals of an episode cannot be replaced.
  ASSERT_TRUE(client_->CloseSession(session->session_id()).ok());
  EXPECT_TRUE(IsSessionLost(session->EndEpisode({.reward = 1.0}).status()));
  EXPECT_TRUE(session->Act(observation_, 0.0).ok());

  RemoteSession other = Open();
  ASSERT_TRUE(client_->CloseSession(other.session_id()).ok());
  EXPECT_TRUE(IsSessionLost(other.Act(observation_, 0.0).status()));
  EXPECT_TRUE(absl::IsFailedPrecondition(other.OpenAgain()));
}

}  // namespace
}  // namespace spikeserve
