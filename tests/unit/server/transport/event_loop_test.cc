#include "server/transport/event_loop.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/epoll.h>

#include <array>
#include <functional>
#include <memory>
#include <string>
#include <thread>
#include <vector>

namespace spikeserve {
namespace {

using ::testing::ElementsAre;

class EventLoopTest : public ::testing::Test {
 protected:
  void Log(const std::string& event) { log_.push_back(event); }

  SteadyClock clock_;
  std::unique_ptr<EventLoop> loop_ = *EventLoop::Create(&clock_);
  std::vector<std::string> log_;
};

TEST_F(EventLoopTest, RunsWhatOtherThreadsPostInOrder) {
  std::thread poster([&] {
    loop_->Post([&] { Log("first"); });
    loop_->Post([&] { Log("second"); });
    loop_->Post([&] { loop_->Stop(); });
  });
  loop_->Run();
  poster.join();
  EXPECT_THAT(log_, ElementsAre("first", "second"));
}

TEST_F(EventLoopTest, TimersRunInTheOrderOfTheirTimes) {
  loop_->After(absl::Milliseconds(2), [&] {
    Log("late");
    loop_->Stop();
  });
  loop_->After(absl::Milliseconds(1), [&] { Log("early"); });
  const auto cancelled = loop_->After(absl::Milliseconds(1), [&] { Log("cancelled"); });
  loop_->Cancel(cancelled);
  loop_->Cancel(cancelled);
  loop_->Cancel({});
  loop_->Run();
  EXPECT_THAT(log_, ElementsAre("early", "late"));
}

TEST_F(EventLoopTest, TheEndOfATurnFollowsItsWork) {
  loop_->AtEndOfTurn([&] { Log("end"); });
  loop_->Post([&] {
    Log("work");
    loop_->Stop();
  });
  loop_->Run();
  EXPECT_THAT(log_, ElementsAre("work", "end"));
}

// Reads one byte, then asks the loop to destroy it.
class OneByte final : public EventLoop::Source {
 public:
  OneByte(EventLoop* loop, FileDescriptor fd, std::function<void()> destroyed)
      : loop_(*loop), fd_(std::move(fd)), destroyed_(std::move(destroyed)) {}
  ~OneByte() override { destroyed_(); }

  void OnReady(uint32_t events) override {
    EXPECT_EQ(events & EPOLLIN, EPOLLIN);
    loop_.Unwatch(fd_.get());
    loop_.DeleteLater(std::unique_ptr<Source>(this));
  }

 private:
  EventLoop& loop_;
  const FileDescriptor fd_;
  const std::function<void()> destroyed_;
};

TEST_F(EventLoopTest, ASourceIsDestroyedAfterTheTurn) {
  std::array<int, 2> ends;
  ASSERT_EQ(pipe(ends.data()), 0);
  const FileDescriptor writer(ends[1]);
  loop_->AtEndOfTurn([&] { Log("end"); });
  auto source = std::make_unique<OneByte>(loop_.get(), FileDescriptor(ends[0]), [&] {
    Log("destroyed");
    loop_->Stop();
  });
  ASSERT_TRUE(loop_->Watch(ends[0], EPOLLIN, source.release()).ok());
  ASSERT_EQ(write(writer.get(), "x", 1), 1);
  loop_->Run();
  EXPECT_THAT(log_, ElementsAre("end", "destroyed"));
}

}  // namespace
}  // namespace spikeserve
