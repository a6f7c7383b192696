#include "core/datagram/sealed_channel.h"

#include <gtest/gtest.h>

#include <random>
#include <set>

namespace spikeserve {
namespace {

using End = SealedChannel::End;

constexpr uint64_t kKeyId = 7;

std::unique_ptr<SealedChannel> Channel(End end, char key = 'k') {
  return *SealedChannel::Create(kKeyId, std::string(kDatagramKeyBytes, key), end);
}

class SealedChannelTest : public ::testing::Test {
 protected:
  std::string Sealed(absl::string_view payload) {
    std::string datagram;
    EXPECT_TRUE(robot_->Seal(payload, &datagram));
    return datagram;
  }
  Opened Open(absl::string_view datagram) {
    return server_->Open(datagram, &payload_, &is_newest_);
  }

  std::unique_ptr<SealedChannel> robot_ = Channel(End::kRobot);
  std::unique_ptr<SealedChannel> server_ = Channel(End::kServer);
  std::string payload_;
  bool is_newest_ = false;
};

TEST_F(SealedChannelTest, CarriesPayloadsBothWays) {
  for (const size_t size : {size_t{0}, size_t{1}, kDatagramPayloadBytes}) {
    const std::string sent(size, 'x');
    const std::string datagram = Sealed(sent);
    EXPECT_EQ(datagram.size(), kDatagramBytes - kDatagramPayloadBytes + size);
    EXPECT_EQ(KeyIdOf(datagram), kKeyId);
    ASSERT_EQ(Open(datagram), Opened::kOk);
    EXPECT_EQ(payload_, sent);
    std::string answer;
    ASSERT_TRUE(server_->Seal(sent, &answer));
    EXPECT_EQ(robot_->Open(answer, &payload_, &is_newest_), Opened::kOk);
    EXPECT_EQ(payload_, sent);
  }
  std::string none;
  EXPECT_FALSE(robot_->Seal(std::string(kDatagramPayloadBytes + 1, 'x'), &none));
  EXPECT_EQ(robot_->sealed(), 3U);
}

TEST_F(SealedChannelTest, RefusesWhatItHasSealedItself) {
  EXPECT_EQ(robot_->Open(Sealed("step"), &payload_, &is_newest_), Opened::kForged);
}

TEST_F(SealedChannelTest, RefusesOtherKeys) {
  const auto other = Channel(End::kServer, 'o');
  EXPECT_EQ(other->Open(Sealed("step"), &payload_, &is_newest_), Opened::kForged);
  const auto other_id =
      *SealedChannel::Create(kKeyId + 1, std::string(kDatagramKeyBytes, 'k'), End::kServer);
  EXPECT_EQ(other_id->Open(Sealed("step"), &payload_, &is_newest_), Opened::kMalformed);
  EXPECT_EQ(SealedChannel::Create(kKeyId, "short", End::kRobot).status().message(),
            "datagrams.key: expected 32 bytes, received 5");
}

TEST_F(SealedChannelTest, TakesReorderedOnesOnceAndTellsTheNewest) {
  std::vector<std::string> sent;
  for (int i = 0; i < 5; ++i) sent.push_back(Sealed(std::to_string(i)));
  for (const auto& [index, is_newest] :
       {std::pair(2, true), std::pair(0, false), std::pair(4, true), std::pair(3, false)}) {
    ASSERT_EQ(Open(sent[static_cast<size_t>(index)]), Opened::kOk) << index;
    EXPECT_EQ(payload_, std::to_string(index));
    EXPECT_EQ(is_newest_, is_newest) << index;
    EXPECT_EQ(Open(sent[static_cast<size_t>(index)]), Opened::kReplayed) << index;
  }
  EXPECT_EQ(Open(sent[1]), Opened::kOk);
}

TEST_F(SealedChannelTest, OneMillionForgedTruncatedAndReplayedOnesOpenNothing) {
  const std::string good = Sealed("a step of the session");
  ASSERT_EQ(Open(good), Opened::kOk);
  std::mt19937_64 random(1);
  for (int i = 0; i < 1'000'000; ++i) {
    std::string datagram = good;
    switch (i % 4) {
      case 0:  // truncated
        datagram.resize(random() % good.size());
        break;
      case 1:  // a counter that is new, also far ahead, which must not move the window
        datagram[13 + random() % 4] = static_cast<char>(1 + random() % 255);
        break;
      case 2:  // one byte is another one
        datagram[random() % good.size()] ^= static_cast<char>(1 + random() % 255);
        break;
      default:  // replayed
        break;
    }
    ASSERT_NE(Open(datagram), Opened::kOk) << i;
  }
  EXPECT_EQ(Open(Sealed("the next step")), Opened::kOk);
  EXPECT_TRUE(is_newest_);
}

TEST(ReplayWindow, AgreesWithASet) {
  std::mt19937_64 random(2);
  ReplayWindow window;
  std::set<uint64_t> seen;
  uint64_t base = 0;
  for (int i = 0; i < 200'000; ++i) {
    if (random() % 500 == 0) base += random() % 5000;
    const uint64_t number = base++ + random() % 1500;
    const uint64_t newest = seen.empty() ? 0 : *seen.rbegin();
    const bool is_old = number < newest && newest - number >= ReplayWindow::kSize;
    ASSERT_EQ(window.IsNew(number), !is_old && !seen.contains(number)) << number;
    if (!window.IsNew(number)) continue;
    ASSERT_EQ(window.Add(number), seen.empty() || number > newest);
    seen.insert(number);
  }
}

TEST(ReplayWindow, ReachesTheLastNumber) {
  ReplayWindow window;
  EXPECT_TRUE(window.Add(0));
  EXPECT_TRUE(window.Add(SealedChannel::kMostDatagrams - 1));
  EXPECT_FALSE(window.IsNew(SealedChannel::kMostDatagrams - 1));
  EXPECT_FALSE(window.IsNew(0));
}

}  // namespace
}  // namespace spikeserve
