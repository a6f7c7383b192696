// Tests of the call Explain: it changes nothing, and needs a decision.
#include <string>

#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

class ExplainTest : public ServerTest {
 protected:
  grpc::Status TryExplain(const std::string& session, v1::ExplainResponse* response) {
    v1::ExplainRequest request;
    request.set_session_id(session);
    return client_->stub().Explain(NewContext().get(), request, response);
  }

  v1::ExplainResponse Explain(const std::string& session) {
    v1::ExplainResponse response;
    const auto status = TryExplain(session, &response);
    EXPECT_TRUE(status.ok()) << status.error_message();
    return response;
  }
};

TEST_F(ExplainTest, AskingChangesNothing) {
  const std::string asked = client_->Open("discrete");
  const std::string left_alone = client_->Open("discrete");
  for (int64_t step = 0; step < 10; ++step) {
    const v1::ActResponse expected = client_->Act(left_alone, step);
    const v1::ActResponse actual = client_->Act(asked, step);
    EXPECT_EQ(actual.action().SerializeAsString(), expected.action().SerializeAsString());
    EXPECT_EQ(actual.stats().spikes(), expected.stats().spikes());
    Explain(asked);
  }
  EXPECT_EQ(Metric("spikeserve_decisions_total"), 20.0);
}

TEST_F(ExplainTest, WithoutADecisionThereIsNothingToExplain) {
  v1::ExplainResponse response;
  ExpectError(TryExplain("nobody", &response), grpc::StatusCode::NOT_FOUND, "nobody");
  const std::string session = client_->Open("discrete");
  ExpectError(TryExplain(session, &response), grpc::StatusCode::FAILED_PRECONDITION, "session_id");
  client_->Act(session, 0);
  EXPECT_TRUE(TryExplain(session, &response).ok());
  client_->EndEpisode(session, 1.0);
  ExpectError(TryExplain(session, &response), grpc::StatusCode::FAILED_PRECONDITION, "step 0");
}

}  // namespace
}  // namespace spikeserve
