#include "spikeserve/unacknowledged.h"

#include "gtest/gtest.h"
#include "spikeserve/client.h"
#include "spikeserve/status.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

v1::ActResponse Answer(uint64_t durable_decision) {
  v1::ActResponse answer;
  answer.set_durable_decision(durable_decision);
  return answer;
}

// Redis may lose what it has acknowledged.
TEST(UnacknowledgedTest, KeepsAlsoWhatTheStoreHas) {
  Unacknowledged unacknowledged;
  EXPECT_FALSE(unacknowledged.Covers(0));
  for (uint64_t i = 0; i < 12; ++i) unacknowledged.Add(i, v1::ActRequest(), Answer(i + 1));
  unacknowledged.Add(12, v1::EndEpisodeRequest(), v1::EndEpisodeResponse());
  EXPECT_EQ(unacknowledged.size(), 13u);
  EXPECT_TRUE(unacknowledged.Covers(0));
  EXPECT_TRUE(unacknowledged.Covers(12));
  EXPECT_FALSE(unacknowledged.Covers(13));
}

TEST(UnacknowledgedTest, KeepsAtMost256Decisions) {
  Unacknowledged unacknowledged;
  for (uint64_t i = 0; i < 1000; ++i) unacknowledged.Add(i, v1::ActRequest(), Answer(0));
  EXPECT_EQ(unacknowledged.size(), 256u);
}

TEST(UnacknowledgedTest, AnAnswerThatChangesIsAnErrorOnce) {
  FakePolicyService fake;
  const auto client = *Client::Create(fake.channel());
  v1::ActRequest request;
  request.set_session_id(client->OpenSession({})->session_id());
  auto answer = *client->Act(request);
  answer.mutable_stats()->set_compute_seconds(1.0);  // may differ
  Unacknowledged unacknowledged;
  unacknowledged.Add(0, request, answer);
  EXPECT_TRUE(unacknowledged.SendAgain(0, client.get(), nullptr).ok());
  answer.mutable_action()->set_discrete(1 - answer.action().discrete());
  unacknowledged.Add(0, request, answer);
  const absl::Status diverged = unacknowledged.SendLastAgain(client.get(), nullptr);
  EXPECT_EQ(DivergedAt(diverged), 0u) << diverged;
  EXPECT_TRUE(unacknowledged.SendLastAgain(client.get(), nullptr).ok());
}

}  // namespace
}  // namespace spikeserve
