#include "server/transport/connection_table.h"

#include <arpa/inet.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <netinet/in.h>

#include <memory>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "server/transport/client_origin.h"

namespace spikeserve {
namespace {

using testing::ElementsAre;
using testing::IsEmpty;
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
  // Connects and makes a call that is admitted.
  void ConnectKnown(ConnectionTable& table, const std::string& address) {
    ASSERT_TRUE(Connect(table, address));
    slots_.back()->MarkCaller();
    slots_.back()->MarkKnown();
  }
  int64_t Refused(const ConnectionTable& table, ConnectionLimit limit) {
    return table.counts().refused[static_cast<size_t>(limit)];
  }
  int64_t Dropped(const ConnectionTable& table, ConnectionLimit limit) {
    return table.counts().dropped[static_cast<size_t>(limit)];
  }

  RecordingCloser closer_;
  Slots slots_;
};

TEST_F(ConnectionTableTest, BoundsKnownConnectionsOfAllOfAHostAndOfANetwork) {
  ConnectionTable table(
      {.connections = 5, .per_address = 2, .per_network = 3, .idle_unauthenticated = 9});
  ConnectKnown(table, "2001:db8:0:1::1");
  ConnectKnown(table, "2001:db8:0:1:ffff::2");
  EXPECT_FALSE(Connect(table, "2001:db8:0:1::3"));  // the same /64
  EXPECT_EQ(Refused(table, ConnectionLimit::kPerAddress), 1);
  ConnectKnown(table, "2001:db8:0:2::1");
  EXPECT_FALSE(Connect(table, "2001:db8:0:3::1"));  // the same /48
  EXPECT_EQ(Refused(table, ConnectionLimit::kPerNetwork), 1);
  ConnectKnown(table, "192.0.2.1");
  ConnectKnown(table, "192.0.2.2");
  EXPECT_FALSE(Connect(table, "198.51.100.1"));
  EXPECT_EQ(Refused(table, ConnectionLimit::kConnections), 1);
  EXPECT_THAT(closer_.closed, IsEmpty());
  slots_.clear();
  EXPECT_EQ(table.counts().open, 0);
  EXPECT_EQ(table.counts().closed, 5);
  EXPECT_TRUE(Connect(table, "192.0.2.1"));
  slots_.clear();
}

TEST_F(ConnectionTableTest, AStrangerOfTheSameHostOrNetworkMakesRoom) {
  ConnectionTable table(
      {.connections = 99, .per_address = 2, .per_network = 3, .idle_unauthenticated = 9});
  ASSERT_TRUE(Connect(table, "192.0.2.1"));  // 0
  slots_.back()->MarkCaller();
  ASSERT_TRUE(Connect(table, "192.0.2.1"));     // 1, without a call
  ASSERT_TRUE(Connect(table, "198.51.100.1"));  // 2
  EXPECT_TRUE(Connect(table, "192.0.2.1"));     // 3
  EXPECT_TRUE(Connect(table, "192.0.2.2"));     // 4
  EXPECT_THAT(closer_.closed, ElementsAre(1));
  ASSERT_TRUE(Connect(table, "192.0.2.2"));  // 5 in place of 3
  EXPECT_THAT(closer_.closed, ElementsAre(1, 3));
  EXPECT_EQ(Dropped(table, ConnectionLimit::kPerAddress), 1);
  EXPECT_EQ(Dropped(table, ConnectionLimit::kPerNetwork), 1);
  slots_.clear();
}

TEST_F(ConnectionTableTest, TheLargestCrowdMakesRoomForOthers) {
  ConnectionTable table(
      {.connections = 8, .per_address = 8, .per_network = 8, .idle_unauthenticated = 8});
  ASSERT_TRUE(Connect(table, "198.51.100.1"));  // 0, the oldest of all, but alone
  for (int i = 1; i <= 5; ++i) {
    ASSERT_TRUE(Connect(table, absl::StrCat("192.0.2.", i)));
    slots_.back()->MarkCaller();  // refused calls do not make a stranger known
  }
  EXPECT_EQ(table.counts().unauthenticated, 6);
  EXPECT_THAT(closer_.closed, IsEmpty());
  ASSERT_TRUE(Connect(table, "203.0.113.1"));  // 6: a quarter of the places is kept
  EXPECT_THAT(closer_.closed, ElementsAre(1));
  EXPECT_EQ(Dropped(table, ConnectionLimit::kReserve), 1);
  for (int i = 0; i < 8; ++i) ConnectKnown(table, "203.0.113.9");
  EXPECT_EQ(table.counts().unauthenticated, 0);
  EXPECT_EQ(table.counts().open, 8);
  EXPECT_FALSE(Connect(table, "203.0.113.77"));
  slots_.clear();
}

TEST_F(ConnectionTableTest, BoundsStrangersWithoutACall) {
  ConnectionTable table(
      {.connections = 99, .per_address = 9, .per_network = 9, .idle_unauthenticated = 2});
  ASSERT_TRUE(Connect(table, "192.0.2.1"));
  ASSERT_TRUE(Connect(table, "192.0.2.2"));
  slots_.front()->MarkCaller();
  ASSERT_TRUE(Connect(table, "192.0.2.3"));
  EXPECT_THAT(closer_.closed, IsEmpty());
  ASSERT_TRUE(Connect(table, "192.0.2.4"));
  EXPECT_THAT(closer_.closed, ElementsAre(1));
  slots_[1]->MarkCaller();  // it is not closed yet
  slots_[1]->MarkKnown();
  slots_.clear();
  EXPECT_EQ(table.counts().open, 0);
  EXPECT_EQ(table.counts().unauthenticated, 0);
}

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

}  // namespace
}  // namespace spikeserve
