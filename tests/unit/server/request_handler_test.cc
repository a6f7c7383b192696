#include "server/request_handler.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <memory>

#include "server/authenticator.h"
#include "tests/unit/server/small_registry.h"
#include "tests/unit/session/fake_clock.h"

namespace spikeserve {
namespace {

class RequestHandlerTest : public ::testing::Test {
 protected:
  std::string MustOpen() {
    v1::OpenSessionRequest request;
    request.set_policy("small");
    v1::OpenSessionResponse response;
    const auto status = handler_.OpenSession(*caller_, request, &response);
    EXPECT_TRUE(status.ok()) << status;
    return response.session_id();
  }

  static v1::ActRequest MakeRequest(const std::string& session, int64_t step) {
    v1::ActRequest request;
    request.set_session_id(session);
    request.set_step(step);
    for (const float value : ObservationAt(step)) request.add_observation(value);
    return request;
  }

  FakeClock clock_;
  std::unique_ptr<Authenticator> authenticator_ = *Authenticator::Create("");
  const Credential* caller_ = *authenticator_->Authenticate("");
  SmallRegistry registry_{"small"};
  ShadowRunner shadows_{registry_.metrics().registry()};
  SessionStore store_{10, &clock_};
  RequestHandler handler_{registry_.get(), &store_, &shadows_, &clock_};
};

TEST_F(RequestHandlerTest, AnswersDoNotDependOnDeferredWork) {
  const std::string prompt = MustOpen();
  const std::string lazy = MustOpen();
  for (int64_t step = 0; step < 20; ++step) {
    v1::ActResponse expected;
    v1::ActResponse actual;
    DeferredWork done;
    DeferredWork dropped;
    ASSERT_TRUE(handler_.Act(*caller_, MakeRequest(prompt, step), &expected, &done).ok());
    done.Run();
    ASSERT_TRUE(handler_.Act(*caller_, MakeRequest(lazy, step), &actual, &dropped).ok());
    actual.set_session_id(prompt);
    EXPECT_EQ(actual.SerializeAsString(), expected.SerializeAsString()) << step;
  }
}

TEST_F(RequestHandlerTest, DeferredWorkMayComeLate) {
  const std::string session = MustOpen();
  DeferredWork first;
  DeferredWork second;
  v1::ActResponse response;
  ASSERT_TRUE(handler_.Act(*caller_, MakeRequest(session, 0), &response, &first).ok());
  ASSERT_TRUE(handler_.Act(*caller_, MakeRequest(session, 1), &response, &second).ok());
  first.Run();
  v1::EndEpisodeRequest end;
  end.set_session_id(session);
  v1::EndEpisodeResponse ended;
  ASSERT_TRUE(handler_.EndEpisode(*caller_, end, &ended).ok());
  second.Run();
  response.Clear();
  EXPECT_TRUE(handler_.Act(*caller_, MakeRequest(session, 0), &response, &first).ok());
}

TEST_F(RequestHandlerTest, ASessionWithWorkLeftIsNotReaped) {
  const std::string session = MustOpen();
  v1::ActResponse response;
  {
    DeferredWork deferred;
    ASSERT_TRUE(handler_.Act(*caller_, MakeRequest(session, 0), &response, &deferred).ok());
    clock_.Advance(absl::Hours(1));
    EXPECT_EQ(store_.RemoveIdle(absl::Minutes(1)), 0);
    deferred.Run();
  }
  EXPECT_EQ(store_.RemoveIdle(absl::Minutes(1)), 1);
}

TEST_F(RequestHandlerTest, OpenSessionsAreCountedByPolicy) {
  const std::string session = MustOpen();
  MustOpen();
  const std::string gauge = "spikeserve_sessions{policy=\"small\",version=\"1\"} ";
  EXPECT_THAT(registry_.metrics().ToText(), ::testing::HasSubstr(gauge + "2\n"));
  v1::CloseSessionRequest close;
  close.set_session_id(session);
  v1::CloseSessionResponse closed;
  ASSERT_TRUE(handler_.CloseSession(*caller_, close, &closed).ok());
  EXPECT_THAT(registry_.metrics().ToText(), ::testing::HasSubstr(gauge + "1\n"));
}

TEST_F(RequestHandlerTest, LongNamesAreCutInMessages) {
  v1::ActResponse response;
  DeferredWork deferred;
  const auto status =
      handler_.Act(*caller_, MakeRequest(std::string(100'000, 'x'), 0), &response, &deferred);
  EXPECT_EQ(status.code(), absl::StatusCode::kNotFound);
  EXPECT_LT(status.message().size(), 200u);
}

}  // namespace
}  // namespace spikeserve
