// When a robot's steps go as datagrams: docs/reference/beats.md has the rules.
#include <gtest/gtest.h>

#include <optional>

#include "core/robot/robot_session.h"

namespace spikeserve::robot {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using What = Task::Kind;

constexpr Time kRoundTrip = milliseconds(50);

class TransportTest : public ::testing::Test {
 protected:
  static constexpr Time kPeriod = milliseconds(20);

  // Opens the stream; the server offers a channel.
  void Connect(int redundancy = 1, size_t observation_size = 1) {
    observation_.assign(observation_size, 1.0f);
    robot_.emplace(Settings{.observation_size = observation_size,
                            .period = kPeriod,
                            .oldest = milliseconds(250),
                            .oldest_held = milliseconds(310),
                            .hold_steps = 3,
                            .most_in_flight = 14,
                            .kept_steps = 100,
                            .sends_datagrams = true,
                            .redundancy = redundancy},
                   ActionShape(10, {}, {}), Opening{.history_limit = 100, .is_stored = true},
                   Clock());
    EXPECT_EQ(robot_->Next(now_).kind, What::kOpenStream);
    robot_->OnStreamOpened(0);
    robot_->OnChannel(now_ + seconds(3600));
  }

  // As Connect, and lets datagrams come through.
  void ConnectAndProve() {
    Connect();
    Steps(5);
    AnswerStream();
  }

  Now Clock() const { return {now_, now_}; }

  // A control step. Returns what is sent, if anything is.
  std::optional<Task> Step() {
    now_ += kPeriod;
    EXPECT_TRUE(robot_->BeginStep({.observation = observation_, .reward = 1.0}, Clock()));
    if (robot_->Choose(Clock(), now_) == Choice::kOwnAction) robot_->TakeOwn(nullptr);
    (void)robot_->FinishStep(Clock());
    return robot_->NextSend(now_);
  }

  // Steps, whose answers to datagrams arrive a round trip later unless `loses` them.
  void Steps(int count, bool loses = false) {
    for (int i = 0; i < count; ++i) {
      const std::optional<Task> task = Step();
      if (task.has_value() && task->ways.stream) ++by_stream_;
      if (task.has_value() && task->ways.datagram) {
        ++by_datagram_;
        if (!loses) arriving_.push_back({now_ + kRoundTrip, task->datagram, task->request.step()});
      }
      while (!arriving_.empty() && arriving_.front().due <= now_) {
        Answer(arriving_.front().number, arriving_.front().step + 1);
        arriving_.erase(arriving_.begin());
      }
    }
  }

  void Answer(uint64_t number, int64_t next_step) {
    robot_->OnDatagram(
        number, {.next_step = next_step, .action = ActionView{.discrete = 7}, .observed_at = now_},
        Clock());
  }
  void Fail(uint64_t number, const Error& error) {
    robot_->OnDatagram(number, {.error = &error}, Clock());
  }
  // The stream answers everything.
  void AnswerStream() {
    for (; by_stream_ > 0; --by_stream_) {
      const int64_t next = static_cast<int64_t>(robot_->step_log().next());
      robot_->OnReply({.next_step = next, .observed_at = now_}, Clock());
    }
  }

  struct Arriving {
    Time due;
    uint64_t number;
    int64_t step;
  };

  Time now_ = Time::zero();
  std::vector<float> observation_;
  std::optional<RobotSession> robot_;
  std::vector<Arriving> arriving_;
  int by_stream_ = 0, by_datagram_ = 0;
};

TEST_F(TransportTest, StepsGoBothWaysUntilTheFirstDatagramIsAnswered) {
  Connect(/*redundancy=*/2);
  const auto first = Step();
  ASSERT_TRUE(first.has_value());
  EXPECT_TRUE(first->ways.stream && first->ways.datagram);
  EXPECT_EQ(first->copies, 2);
  EXPECT_FALSE(robot_->SendsDatagrams(now_));
  Answer(first->datagram, 1);
  EXPECT_TRUE(robot_->HasAnswer());
  EXPECT_TRUE(robot_->SendsDatagrams(now_));
  const auto second = Step();
  ASSERT_TRUE(second.has_value());
  EXPECT_TRUE(!second->ways.stream && second->ways.datagram);
  EXPECT_EQ(second->datagram, first->datagram + 1);
}

TEST_F(TransportTest, TheNewestAnswerWins) {
  Connect();
  const auto first = Step(), second = Step(), third = Step();
  ASSERT_TRUE(first && second && third);
  Answer(second->datagram, 2);
  EXPECT_EQ(robot_->counters().counts().datagram_answers, 1U);
  Answer(first->datagram, 1);   // overtaken
  Answer(second->datagram, 2);  // doubled
  Answer(77, 2);                // never sent
  EXPECT_EQ(robot_->counters().counts().datagram_answers, 1U);
  EXPECT_EQ(Step()->request.begin, 1U);  // the history begins before the step that is expected
  Answer(third->datagram, 3);
  EXPECT_EQ(robot_->counters().counts().datagram_answers, 2U);
}

TEST_F(TransportTest, SingleLossesDoNotBringTheStreamBack) {
  ConnectAndProve();
  for (int i = 0; i < 20; ++i) {
    Steps(1, /*loses=*/true);
    Steps(9);
  }
  EXPECT_EQ(by_stream_, 0);
}

TEST_F(TransportTest, AnAnswerThatIsLateIsNotAwaited) {
  constexpr Time kWait = milliseconds(10);
  Connect();
  std::vector<uint64_t> sent;
  for (int i = 0; i < 60; ++i) {
    const auto task = Step();
    if (task->ways.stream) ++by_stream_;
    sent.push_back(task->datagram);
    if (i < 2) continue;
    now_ += milliseconds(15);
    Answer(sent[sent.size() - 3], robot_->step_log().next() - 2);  // after 55 ms
    now_ -= milliseconds(15);
  }
  AnswerStream();
  sent.push_back(Step()->datagram);  // an answer is missing
  now_ += kPeriod;
  EXPECT_TRUE(robot_->BeginStep({.observation = observation_, .reward = 1.0}, Clock()));
  EXPECT_EQ(robot_->Choose(Clock(), now_ + kWait), Choice::kTaken);
  (void)robot_->FinishStep(Clock());
  Fail(sent.back(), {.kind = Failure::kOther});
  // In doubt, the stream has the request, too, and what it brings late is awaited.
  Step();
  Step();
  now_ += kPeriod;
  EXPECT_TRUE(robot_->BeginStep({.observation = observation_, .reward = 1.0}, Clock()));
  EXPECT_EQ(robot_->Choose(Clock(), now_ + 3 * kPeriod), Choice::kWait);
}

TEST_F(TransportTest, AFirewallBringsTheStreamBackUntilDatagramsComeThrough) {
  Connect();
  Steps(10);
  AnswerStream();
  Steps(5, /*loses=*/true);
  EXPECT_EQ(by_stream_, 0);
  Steps(1, /*loses=*/true);
  EXPECT_EQ(by_stream_, 1);  // the first answer is overdue
  for (int i = 0; i < 200; ++i) {
    Steps(1, /*loses=*/true);
    AnswerStream();
  }
  // Each step goes over the stream, and a datagram probes the way once a second.
  by_datagram_ = 0;
  for (int i = 0; i < 200; ++i) {
    Steps(1, /*loses=*/true);
    EXPECT_EQ(by_stream_, 1) << i;
    AnswerStream();
  }
  EXPECT_EQ(by_datagram_, 4);
  for (int i = 0; i < 60 && !robot_->SendsDatagrams(now_); ++i) Steps(1), AnswerStream();
  EXPECT_TRUE(robot_->SendsDatagrams(now_));
}

TEST_F(TransportTest, AnErrorIsLeftToTheStream) {
  ConnectAndProve();
  const auto task = Step();
  Error late;
  late.expected_decision = 77;  // of a session that the stream may know better
  Fail(task->datagram, late);
  EXPECT_EQ(robot_->link(), LinkState::kOnline);
  EXPECT_TRUE(robot_->SendsDatagrams(now_));
  Fail(Step()->datagram, {.kind = Failure::kInvalid});
  EXPECT_EQ(robot_->link(), LinkState::kOnline);
  EXPECT_FALSE(robot_->SendsDatagrams(now_));
  EXPECT_TRUE(Step()->ways.stream);
}

TEST_F(TransportTest, ErrorsAboutTheOrderThatDoNotEndAreMoreThanReordering) {
  ConnectAndProve();
  Error other;
  other.expected_decision = 77;  // another robot has the session's id
  for (int i = 0; i < TransportChoice::kDisorders; ++i) {
    EXPECT_TRUE(robot_->SendsDatagrams(now_));
    Fail(Step()->datagram, other);
  }
  EXPECT_TRUE(Step()->ways.stream);
}

TEST_F(TransportTest, DatagramsGoOnWhileTheStreamIsOpenedAgain) {
  Connect();
  Steps(5);
  robot_->OnStreamEnded({.kind = Failure::kAway});
  EXPECT_EQ(robot_->Next(now_).kind, What::kCloseStream);
  robot_->OnStreamClosed(/*is_renewed=*/false, now_);
  const auto task = Step();
  ASSERT_TRUE(task.has_value());
  EXPECT_TRUE(!task->ways.stream && task->ways.datagram);
}

TEST_F(TransportTest, ARequestThatADatagramWithTheEndHasOvertakenChangesNothing) {
  Connect();
  Steps(5);
  ASSERT_GT(by_stream_, 0);  // whose answers are under way
  robot_->EndEpisode({.reward = 1.0}, nullptr);
  const Task end = robot_->Next(now_);
  Error late;
  late.expected_decision = 6;
  late.expected_episode = 1;
  for (; by_stream_ > 0; --by_stream_) robot_->OnReply({.error = &late}, Clock());
  EXPECT_EQ(robot_->link(), LinkState::kOnline);
  EXPECT_TRUE(robot_->OnDatagram(end.datagram, {.has_ended = true}, Clock()).settled.has_value());
}

TEST_F(TransportTest, WhatDoesNotFitGoesOverTheStream) {
  Connect(1, /*observation_size=*/40);
  int steps = 0;
  while (Step()->ways.datagram) ++steps;  // the history grows, because nothing is answered
  EXPECT_GE(steps, 3);
  EXPECT_LE(steps, 1159 / (4 * 40));
}

TEST_F(TransportTest, AChannelThatHasExpiredIsNotUsed) {
  Connect();
  robot_->OnChannel(now_ + 3 * kPeriod);
  EXPECT_TRUE(Step()->ways.datagram);
  now_ += 3 * kPeriod;
  const auto task = Step();
  EXPECT_TRUE(task->ways.stream && !task->ways.datagram);
}

}  // namespace
}  // namespace spikeserve::robot
