#include "server/transport/limits.h"

#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>

#include <memory>
#include <string>
#include <vector>

#include "server/base/byte_budget.h"
#include "server/transport/client_origin.h"
#include "server/transport/connection_table.h"
#include "server/transport/frame_budget.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;

using Slots = std::vector<std::unique_ptr<ConnectionSlot>>;

class RecordingCloser final : public ConnectionCloser {
 public:
  void CloseSoon(uint64_t number) override { closed.push_back(number); }
  std::vector<uint64_t> closed;
};

ClientOrigin OriginOfText(const std::string& text) {
  sockaddr_storage peer = {};
  auto& address4 = reinterpret_cast<sockaddr_in&>(peer);
  auto& address6 = reinterpret_cast<sockaddr_in6&>(peer);
  if (inet_pton(AF_INET, text.c_str(), &address4.sin_addr) == 1) {
    peer.ss_family = AF_INET;
  } else {
    EXPECT_EQ(inet_pton(AF_INET6, text.c_str(), &address6.sin6_addr), 1);
    peer.ss_family = AF_INET6;
  }
  return OriginOf(peer);
}

TEST(ClientOriginTest, GroupsAddressesByWhoCanHaveThem) {
  const ClientOrigin v4 = OriginOfText("192.0.2.7");
  EXPECT_EQ(v4.address, "192.0.2.7");
  EXPECT_EQ(v4.host, "192.0.2.7");
  EXPECT_EQ(v4.network, "192.0.2.0/24");
  const ClientOrigin v6 = OriginOfText("2001:db8:1:2:3:4:5:6");
  EXPECT_EQ(v6.address, "2001:db8:1:2:3:4:5:6");
  EXPECT_EQ(v6.host, "2001:db8:1:2::/64");
  EXPECT_EQ(v6.network, "2001:db8:1::/48");
  const ClientOrigin mapped = OriginOfText("::ffff:192.0.2.7");
  EXPECT_EQ(mapped.host, "192.0.2.7");
  EXPECT_EQ(mapped.network, "192.0.2.0/24");
  sockaddr_storage local = {};
  local.ss_family = AF_UNIX;
  EXPECT_EQ(OriginOf(local).host, "unix");
}

class ConnectionTableTest : public testing::Test {
 protected:
  // Returns whether a connection from `address` was admitted, and keeps it.
  bool Connect(ConnectionTable& table, const std::string& address) {
    auto slot = table.Admit(OriginOfText(address), &closer_);
    if (slot == nullptr) return false;
    slots_.push_back(std::move(slot));
    return true;
  }

  RecordingCloser closer_;
  Slots slots_;
};

TEST_F(ConnectionTableTest, DropsAsManyStrangersAsFreeTheBytes) {
  ConnectionTable table(
      {.connections = 99, .per_address = 9, .per_network = 9, .idle_unauthenticated = 9});
  table.DropUnauthenticated(ConnectionLimit::kUnauthenticatedBytes, 1);
  for (int i = 0; i < 5; ++i) ASSERT_TRUE(Connect(table, "192.0.2.1"));
  table.DropUnauthenticated(ConnectionLimit::kUnauthenticatedBytes, 1);
  table.DropUnauthenticated(ConnectionLimit::kUnauthenticatedBytes,
                            kConnectionBytes);  // is about to be freed
  EXPECT_THAT(closer_.closed, ElementsAre(0));
  slots_.erase(slots_.begin());
  table.DropUnauthenticated(ConnectionLimit::kUnauthenticatedBytes, 2 * kConnectionBytes);
  EXPECT_THAT(closer_.closed, ElementsAre(0, 1, 2));
  slots_.clear();
}

TEST_F(ConnectionTableTest, ExpectsNoBytesOfDroppedConnectionsThatFreedThem) {
  ConnectionTable table(
      {.connections = 99, .per_address = 9, .per_network = 9, .idle_unauthenticated = 9});
  for (int i = 0; i < 5; ++i) ASSERT_TRUE(Connect(table, "192.0.2.1"));
  table.DropUnauthenticated(ConnectionLimit::kUnauthenticatedBytes, 2 * kConnectionBytes);
  EXPECT_THAT(closer_.closed, ElementsAre(0, 1));
  slots_[0]->MarkFreed();  // it is not removed yet
  slots_[1]->MarkKnown();
  table.DropUnauthenticated(ConnectionLimit::kUnauthenticatedBytes, 1);
  EXPECT_THAT(closer_.closed, ElementsAre(0, 1, 2));
  slots_.clear();
  EXPECT_EQ(table.counts().open, 0);
}

// Returns how many frames pass at `now`.
int Frames(FrameBudget* budget, absl::Duration now) {
  int frames = 0;
  while (frames < 1000 && budget->Take(now)) ++frames;
  return frames;
}

TEST(FrameBudgetTest, HoldsOneSecond) {
  FrameBudget budget(10);
  EXPECT_EQ(Frames(&budget, absl::Seconds(100)), 20);  // full at first, and refilled once
  EXPECT_EQ(Frames(&budget, absl::Milliseconds(100'500)), 5);
  EXPECT_EQ(Frames(&budget, absl::Seconds(200)), 10);
}

TEST(FrameBudgetTest, EarnsWhatThePeerMayAnswer) {
  FrameBudget budget(10);
  Frames(&budget, absl::Seconds(100));
  budget.Earn();
  EXPECT_EQ(Frames(&budget, absl::Seconds(100)), 4);
}

TEST(ByteBudgetTest, Bounds) {
  ByteBudget budget;
  EXPECT_TRUE(budget.Count(60, 100));
  EXPECT_FALSE(budget.Count(41, 100));
  EXPECT_EQ(budget.used(), 101);
  EXPECT_TRUE(budget.Count(-41, 100));
  EXPECT_TRUE(budget.Count(40, 100));
  EXPECT_TRUE(budget.Count(-100, 0));
  EXPECT_EQ(budget.used(), 0);
}

}  // namespace
}  // namespace spikeserve
