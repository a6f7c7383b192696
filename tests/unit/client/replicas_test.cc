#include "client/src/replicas.h"

#include <map>
#include <set>

#include "gtest/gtest.h"
#include "spikeserve/client.h"
#include "spikeserve/remote_session.h"
#include "tests/support/fake_policy_service.h"

namespace spikeserve {
namespace {

// The Python client computes the same numbers: tests/python/client/test_replicas.py.
TEST(ReplicasTest, AllClientsRankTheServersEqually) {
  const std::string key = "0123456789abcdef0123456789abcdef";
  EXPECT_EQ(Rank(key, "10.0.0.1:50051"), 15574301511887128372u);
  EXPECT_EQ(Rank(key, "unix:/a"), 15821398357803811023u);
}

TEST(ReplicasTest, ParsesAddresses) {
  const auto servers = ParseServers("10.0.0.1:50051, unix:/run/spikeserve.sock");
  ASSERT_TRUE(servers.ok()) << servers.status();
  EXPECT_EQ(*servers, (std::vector<std::string>{"10.0.0.1:50051", "unix:/run/spikeserve.sock"}));
  EXPECT_EQ(ParseServers("a:1,,b:2").status().message(),
            "server: expected HOST:PORT or unix:PATH, several separated by commas, received "
            "\"a:1,,b:2\"");
}

TEST(ReplicasTest, IdsAreOf128Bits) {
  std::set<std::string> ids;
  for (int i = 0; i < 100; ++i) {
    const std::string id = DrawId();
    EXPECT_EQ(id.size(), 32u);
    EXPECT_EQ(id.find_first_not_of("0123456789abcdef"), std::string::npos) << id;
    ids.insert(id);
  }
  EXPECT_EQ(ids.size(), 100u);
}

class FakeReplicasTest : public ::testing::Test {
 protected:
  FakeReplicasTest() {
    std::vector<std::unique_ptr<Replica>> all;
    int i = 0;
    for (const FakePolicyService& fake : fakes_) {
      all.push_back(std::make_unique<Replica>(std::string(1, static_cast<char>('a' + i++)),
                                              fake.channel(), nullptr));
      present_.insert(all.back().get());
    }
    replicas_ = std::make_unique<Replicas>(std::move(all), absl::Hours(1), absl::Hours(1));
  }

  FakePolicyService fakes_[3];
  std::set<const Replica*> present_;
  std::unique_ptr<Replicas> replicas_;
};

TEST_F(FakeReplicasTest, SessionsAreSpreadAndReturnToTheirReplica) {
  std::map<const Replica*, int> sessions;
  for (int i = 0; i < 300; ++i) {
    Route route(DrawId());
    Replica* const preferred = replicas_->Choose(route);
    ++sessions[preferred];
    replicas_->Failed(*preferred);
    EXPECT_NE(replicas_->Choose(route), preferred);
    replicas_->Answered(route, *preferred);
    EXPECT_EQ(replicas_->Choose(route), preferred);
  }
  EXPECT_EQ(sessions.size(), 3u);
  for (const auto& [replica, count] : sessions) EXPECT_GT(count, 50) << replica->address;
}

TEST_F(FakeReplicasTest, AllAreTriedBeforeOneIsTriedAgain) {
  Route route(DrawId());
  std::set<const Replica*> tried;
  for (int i = 0; i < 3; ++i) {
    Replica* const replica = replicas_->Choose(route, tried);
    EXPECT_TRUE(tried.insert(replica).second);
    replicas_->Failed(*replica);
  }
  EXPECT_EQ(tried, present_);
  EXPECT_NE(replicas_->Choose(route, tried), nullptr);
}

TEST_F(FakeReplicasTest, APinnedRouteStays) {
  Route route(DrawId());
  Replica* const home = replicas_->Choose(route);
  replicas_->Answered(route, *home);
  EXPECT_TRUE(replicas_->MayMove(route));
  replicas_->Pin(route, true);
  replicas_->Failed(*home);
  EXPECT_EQ(replicas_->Choose(route), home);
  EXPECT_EQ(replicas_->PinnedTo(route), home);
  EXPECT_FALSE(replicas_->MayMove(route));
}

TEST_F(FakeReplicasTest, AShortSilenceLeadsToACheckOnly) {
  Route route(DrawId());
  Replica* const preferred = replicas_->Choose(route);
  replicas_->Failed(*preferred, kProbeTimeout / 2);
  EXPECT_EQ(replicas_->Choose(route), preferred);
  replicas_->Failed(*preferred, kProbeTimeout);
  EXPECT_NE(replicas_->Choose(route), preferred);
}

}  // namespace
}  // namespace spikeserve
