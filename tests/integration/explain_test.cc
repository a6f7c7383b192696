// Tests of the call Explain: its spikes equal those that Act counted, and it does not change the
// session.
#include <cmath>
#include <map>
#include <numeric>
#include <string>
#include <thread>
#include <vector>

#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

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

  // Plays a session and expects that the spikes of each explanation are those that Act counted.
  // Returns the stats of the last decision.
  v1::DecisionStats ExpectCounted(const std::string& policy);
};

std::map<std::string, uint64_t> SpikesByStage(const v1::ExplainResponse& explained) {
  std::map<std::string, uint64_t> spikes;
  for (const v1::SpikeRaster& raster : explained.rasters()) {
    EXPECT_EQ(raster.ticks_size(), raster.neurons_size());
    spikes[raster.stage()] += static_cast<uint64_t>(raster.ticks_size());
  }
  return spikes;
}

v1::DecisionStats ExplainTest::ExpectCounted(const std::string& policy) {
  const std::string session = client_->Open(policy);
  v1::ActResponse answer;
  for (int64_t step = 0; step < 15; ++step) {
    answer = client_->Act(session, step);
    const v1::ExplainResponse explained = Explain(session);
    EXPECT_EQ(explained.answer().SerializeAsString(), answer.SerializeAsString());
    const v1::SpikesByStage& stages = answer.stats().spikes_by_stage();
    const std::map<std::string, uint64_t> expected = {
        {"coder", stages.coder()},           {"phase", stages.phase()},
        {"query", stages.query()},           {"key", stages.key()},
        {"value", stages.value()},           {"ffn_in", stages.ffn_in()},
        {"ffn_hidden", stages.ffn_hidden()}, {"readout", stages.readout()}};
    EXPECT_EQ(SpikesByStage(explained), expected) << policy << " at step " << step;
  }
  return answer.stats();
}

TEST_F(ExplainTest, RastersAddUpToWhatActCounted) {
  for (const std::string policy : {"discrete", "box"}) ExpectCounted(policy);
}

TEST_F(ExplainTest, RastersOfIntegerPoliciesAddUpToWhatActCounted) {
  WriteIntegerVersion(policies_.path(), "discrete", 2);
  WriteIntegerVersion(policies_.path(), "box", 1);
  StartServer();  // serves the new versions by default
  for (const std::string policy : {"discrete", "box"}) {
    const v1::DecisionStats stats = ExpectCounted(policy);
    EXPECT_GT(stats.integer_multiply_accumulates(), 0u);
    EXPECT_LT(stats.int_energy_joules(), stats.energy_joules());
  }
}

TEST_F(ExplainTest, SaysWhatWentInAndCameOut) {
  const std::string session = client_->Open("discrete");
  for (int64_t step = 0; step < 3; ++step) client_->Act(session, step);
  const v1::ExplainResponse explained = Explain(session);
  EXPECT_EQ(explained.session_id(), session);
  EXPECT_EQ(explained.policy(), "discrete");
  EXPECT_EQ(explained.version(), 2);
  EXPECT_EQ(explained.mode(), "full");
  EXPECT_EQ(explained.layers(), 2);
  EXPECT_EQ(explained.heads(), 2);
  EXPECT_EQ(explained.ticks(), 5);
  const v1::ActRequest request = MakeActRequest(session, 2);
  EXPECT_THAT(explained.observation(), ::testing::ElementsAreArray(request.observation().begin(),
                                                                   request.observation().end()));
  ASSERT_EQ(explained.logits_size(), 2);
  const double odds = std::exp(explained.logits(0) - explained.logits(1));
  EXPECT_NEAR(explained.answer().action_probabilities(0), odds / (1.0 + odds), 1e-5);
  ASSERT_EQ(explained.attention_size(), 2);
  EXPECT_EQ(explained.attention(0).keys_size(), 8);  // three timesteps, the last without its action
  EXPECT_EQ(explained.attention(0).weights_size(), 5 * 2 * 8);
  ASSERT_EQ(explained.routing_size(), 2);
  EXPECT_EQ(explained.routing(0).gates_size(), explained.routing(0).tokens_size() * 5 * 2);
  EXPECT_EQ(explained.routing(1).tokens_size(), 1);
}

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

// There are more calls than may wait at a time. Each is answered, or refused with a code that
// allows a retry.
TEST_F(ExplainTest, AFloodIsAnsweredOrRefused) {
  const std::string session = client_->Open("discrete");
  client_->Act(session, 0);
  std::vector<grpc::Status> statuses(64);
  std::vector<std::thread> threads;
  for (grpc::Status& status : statuses) {
    threads.emplace_back([&] {
      v1::ExplainResponse response;
      status = TryExplain(session, &response);
    });
  }
  for (std::thread& thread : threads) thread.join();
  int answered = 0;
  for (const grpc::Status& status : statuses) {
    answered += status.ok();
    if (!status.ok()) {
      ExpectError(status, grpc::StatusCode::UNAVAILABLE, "ask again later");
    }
  }
  EXPECT_GT(answered, 0);
}

}  // namespace
}  // namespace spikeserve
