// Tests of every error of the wire contract: the status code and the message that a client
// receives.
#include <limits>

#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

using grpc::StatusCode;

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kInfinity = std::numeric_limits<double>::infinity();

class OpenErrorsTest : public ServerTest {
 protected:
  v1::OpenSessionRequest request_ = [] {
    v1::OpenSessionRequest request;
    request.set_policy("discrete");
    return request;
  }();
};

TEST_F(OpenErrorsTest, UnknownPolicy) {
  request_.set_policy("walker");
  ExpectError(client_->TryOpen(request_), StatusCode::NOT_FOUND,
              "policy: expected one of [box, discrete], received \"walker\"");
}

TEST_F(OpenErrorsTest, TooLongAMessage) {
  StartServer({"--max_message_bytes=1000"});
  request_.set_policy(std::string(900, 'x'));
  ExpectError(client_->TryOpen(request_), StatusCode::NOT_FOUND, "policy: expected");
  request_.set_policy(std::string(1000, 'x'));
  ExpectError(client_->TryOpen(request_), StatusCode::RESOURCE_EXHAUSTED,
              "--max_message_bytes: expected at most 1000, received 10");
  request_.set_policy(std::string(65 << 20, 'x'));
  ExpectError(client_->TryOpen(request_), StatusCode::RESOURCE_EXHAUSTED,
              "--max_message_bytes: expected at most 1000, received 681574");
}

TEST_F(OpenErrorsTest, UnknownVersion) {
  for (const int64_t version : {3, -1}) {
    request_.set_version(version);
    ExpectError(client_->TryOpen(request_), StatusCode::NOT_FOUND,
                "version: expected 0 or one of [1, 2] of policy discrete, received " +
                    std::to_string(version));
  }
}

TEST_F(OpenErrorsTest, TargetReturnMustBeFinite) {
  for (const double target : {kNan, kInfinity, -1e300}) {
    request_.set_target_return(target);
    ExpectError(client_->TryOpen(request_), StatusCode::INVALID_ARGUMENT,
                "target_return: expected a finite number within float32");
  }
}

TEST_F(OpenErrorsTest, TemperatureNeedsSampling) {
  request_.set_temperature(1.0);
  ExpectError(client_->TryOpen(request_), StatusCode::INVALID_ARGUMENT,
              "temperature: expected unset unless action_selection is SAMPLE, received 1");
}

TEST_F(OpenErrorsTest, TemperatureMustBePositive) {
  request_.set_action_selection(v1::SAMPLE);
  for (const double temperature : {0.0, -1.0, kNan, kInfinity, 1e-300}) {
    request_.set_temperature(temperature);
    ExpectError(client_->TryOpen(request_), StatusCode::INVALID_ARGUMENT,
                "temperature: expected a finite number above 0");
  }
}

TEST_F(OpenErrorsTest, UnknownActionSelection) {
  request_.set_action_selection(static_cast<v1::ActionSelection>(7));
  ExpectError(client_->TryOpen(request_), StatusCode::INVALID_ARGUMENT,
              "action_selection: expected GREEDY or SAMPLE, received 7");
}

TEST_F(OpenErrorsTest, AFleetsHeadHasTheServersBounds) {
  request_.mutable_learning()->set_scope(v1::LearningConfig::FLEET);
  request_.mutable_learning()->set_max_drift(5.0);
  ExpectError(client_->TryOpen(request_), StatusCode::INVALID_ARGUMENT,
              "learning.max_drift: expected unset unless scope is SESSION");
}

TEST_F(OpenErrorsTest, Learning) {
  const auto refuse = [&](const std::string& message) {
    ExpectError(client_->TryOpen(request_), StatusCode::INVALID_ARGUMENT, message);
    request_.clear_learning();
  };
  request_.mutable_learning()->set_scope(static_cast<v1::LearningConfig::Scope>(7));
  refuse("learning.scope: expected SESSION or FLEET, received 7");
  request_.mutable_learning()->set_rule("sarsa");
  refuse("learning.rule: expected policy_gradient, hebbian or hebbian_action, received \"sarsa\"");
  request_.mutable_learning()->set_modulator("dopamine");
  refuse("learning.modulator: expected target or realized, received \"dopamine\"");
  request_.mutable_learning()->set_learning_rate(-1);
  refuse("learning.learning_rate: expected a finite number above 0");
  request_.mutable_learning()->set_trace_decay(2);
  refuse("learning.trace_decay: expected a number from 0 to 1, received 2");
  request_.mutable_learning()->set_clip(0);
  refuse("learning.clip: expected a finite number above 0");
  request_.mutable_learning()->set_max_drift(kNan);
  refuse("learning.max_drift: expected a finite number above 0, received nan");
}

TEST_F(OpenErrorsTest, LabelsAreBounded) {
  request_.mutable_labels()->insert({"key", std::string(257, 'x')});
  ExpectError(client_->TryOpen(request_), StatusCode::INVALID_ARGUMENT,
              "labels: expected keys and values of at most 256 bytes, received one of 257");
  request_.clear_labels();
  for (int i = 0; i < 33; ++i) request_.mutable_labels()->insert({std::to_string(i), ""});
  ExpectError(client_->TryOpen(request_), StatusCode::INVALID_ARGUMENT,
              "labels: expected at most 32, received 33");
}

TEST_F(OpenErrorsTest, SessionLimit) {
  StartServer({"--max_sessions=2"});
  const std::string session = client_->Open();
  client_->Open();
  ExpectError(client_->TryOpen(request_), StatusCode::RESOURCE_EXHAUSTED,
              "max_sessions: expected fewer than 2 open sessions");
  v1::CloseSessionRequest close;
  close.set_session_id(session);
  v1::CloseSessionResponse closed;
  ASSERT_TRUE(client_->stub().CloseSession(NewContext().get(), close, &closed).ok());
  EXPECT_TRUE(client_->TryOpen(request_).ok());
}

class SessionErrorsTest : public ServerTest {
 protected:
  // Expects that the session is unchanged: it has made two decisions and waits for the third.
  void ExpectUnchanged(const std::string& session) {
    v1::GetSessionRequest request;
    request.set_session_id(session);
    v1::GetSessionResponse response;
    ASSERT_TRUE(client_->stub().GetSession(NewContext().get(), request, &response).ok());
    EXPECT_EQ(response.step(), 2);
    EXPECT_EQ(response.decisions(), 2u);
    EXPECT_EQ(response.episode(), 0);
  }

  std::string OpenAtStepTwo() {
    const std::string session = client_->Open();
    client_->Act(session, 0);
    client_->Act(session, 1);
    return session;
  }
};

TEST_F(SessionErrorsTest, UnknownSession) {
  const std::string message = "session_id: expected an open session, received \"nobody\"";
  v1::GetSessionRequest get;
  get.set_session_id("nobody");
  v1::GetSessionResponse got;
  v1::CloseSessionRequest close;
  close.set_session_id("nobody");
  v1::CloseSessionResponse closed;
  v1::EndEpisodeRequest end;
  end.set_session_id("nobody");
  for (const grpc::Status& status :
       {client_->TryAct(MakeActRequest("nobody", 0)), client_->TryEndEpisode(end),
        client_->stub().GetSession(NewContext().get(), get, &got),
        client_->stub().CloseSession(NewContext().get(), close, &closed)}) {
    ExpectError(status, StatusCode::NOT_FOUND, message);
  }
}

TEST_F(SessionErrorsTest, AClosedSessionIsUnknown) {
  const std::string session = client_->Open();
  v1::CloseSessionRequest close;
  close.set_session_id(session);
  v1::CloseSessionResponse closed;
  ASSERT_TRUE(client_->stub().CloseSession(NewContext().get(), close, &closed).ok());
  ExpectError(client_->TryAct(MakeActRequest(session, 0)), StatusCode::NOT_FOUND, session);
}

TEST_F(SessionErrorsTest, StepOutOfOrder) {
  const std::string session = OpenAtStepTwo();
  for (const int64_t step : {-1, 0, 3}) {
    ExpectError(client_->TryAct(MakeActRequest(session, step)), StatusCode::FAILED_PRECONDITION,
                "step: expected 2, received " + std::to_string(step));
  }
  ExpectUnchanged(session);
}

TEST_F(SessionErrorsTest, ObservationLength) {
  const std::string session = OpenAtStepTwo();
  v1::ActRequest request = MakeActRequest(session, 2);
  request.add_observation(0.0f);
  ExpectError(client_->TryAct(request), StatusCode::INVALID_ARGUMENT,
              "observation: expected 4 numbers, received 5");
  request.clear_observation();
  ExpectError(client_->TryAct(request), StatusCode::INVALID_ARGUMENT,
              "observation: expected 4 numbers, received 0");
  ExpectUnchanged(session);
}

TEST_F(SessionErrorsTest, NumbersMustBeFinite) {
  const std::string session = OpenAtStepTwo();
  v1::ActRequest request = MakeActRequest(session, 2);
  request.set_observation(3, static_cast<float>(kNan));
  ExpectError(client_->TryAct(request), StatusCode::INVALID_ARGUMENT,
              "observation[3]: expected a finite number, received nan");
  request = MakeActRequest(session, 2);
  request.set_reward(-kInfinity);
  ExpectError(client_->TryAct(request), StatusCode::INVALID_ARGUMENT,
              "reward: expected a finite number, received -inf");
  v1::EndEpisodeRequest end;
  end.set_session_id(session);
  end.set_reward(kNan);
  ExpectError(client_->TryEndEpisode(end), StatusCode::INVALID_ARGUMENT,
              "reward: expected a finite number, received nan");
  end.set_reward(0.0);
  end.set_target_return(kInfinity);
  ExpectError(client_->TryEndEpisode(end), StatusCode::INVALID_ARGUMENT,
              "target_return: expected a finite number");
  ExpectUnchanged(session);
}

TEST_F(SessionErrorsTest, EndOfAnEpisodeWithoutDecisions) {
  const std::string session = OpenAtStepTwo();
  v1::EndEpisodeRequest end;
  end.set_session_id(session);
  EXPECT_TRUE(client_->TryEndEpisode(end).ok());
  end.set_reward(1.0);
  ExpectError(client_->TryEndEpisode(end), StatusCode::FAILED_PRECONDITION,
              "expected at least one decision since the last episode ended");
}

}  // namespace
}  // namespace spikeserve
