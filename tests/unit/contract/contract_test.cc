// Breaks contracts of headers: what a method requires, the thread that a class is confined to, and
// the order of destruction. Each must abort. This program is compiled with the checks in every
// build type.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <memory>
#include <thread>

#include "core/base/clock.h"
#include "core/contract/dcheck.h"
#include "core/contract/thread_checker.h"
#include "core/session/history.h"
#include "server/transport/event_loop.h"
#include "server/transport/frame_memory.h"

namespace spikeserve {
namespace {

class StoppedClock final : public Clock {
 public:
  absl::Duration Now() const override { return absl::ZeroDuration(); }
};

TEST(DCheckTest, PrintsTheExpressionAndItsValues) {
  int evaluated = 0;
  SPIKESERVE_DCHECK(++evaluated == 1);
  SPIKESERVE_DCHECK_EQ(evaluated, 1);
  EXPECT_DEATH(SPIKESERVE_DCHECK(false), "contract_test.cc:[0-9]+: check failed: false");
  EXPECT_DEATH(SPIKESERVE_DCHECK_LT(evaluated, 1), "check failed: evaluated < 1 \\(1 vs. 1\\)");
}

TEST(ThreadCheckerTest, KnowsTheBoundThread) {
  ThreadChecker checker;
  EXPECT_TRUE(checker.IsCurrent());
  checker.Bind();
  EXPECT_TRUE(checker.IsCurrent());
  std::thread([&] { EXPECT_FALSE(checker.IsCurrent()); }).join();
  checker.Release();
  std::thread([&] { EXPECT_TRUE(checker.IsCurrent()); }).join();
}

TEST(ThreadCheckerTest, OnlyOneThreadIsBound) {
  ThreadChecker checker;
  std::thread([&] { checker.Bind(); }).join();
  EXPECT_DEATH(checker.AssertCurrent(), "check failed: IsCurrent");
  EXPECT_DEATH(checker.Bind(), "check failed");
  EXPECT_DEATH(checker.Release(), "check failed");
}

TEST(BrokenContractTest, AnotherThreadUsesARunningLoop) {
  const StoppedClock clock;
  const auto use_from_another_thread = [&] {
    const auto loop = EventLoop::Create(&clock);
    (*loop)->Post(
        [&] { std::thread([&] { (*loop)->After(absl::ZeroDuration(), [] {}); }).join(); });
    (*loop)->Run();
  };
  EXPECT_DEATH(use_from_another_thread(), "event_loop.cc|thread_checker.h");
}

TEST(BrokenContractTest, ASessionOutlivesItsFrameMemory) {
  const auto destroy_first = [] {
    FrameMemory memory;
    memory.allocator()->malloc(16 << 10, &memory);  // as nghttp2 allocates its frame buffer
  };
  EXPECT_DEATH(destroy_first(), "frame_memory.cc");
}

TEST(BrokenContractTest, ATimestepThatDoesNotExist) {
  History history;
  Action push;
  push.discrete = 1;
  EXPECT_DEATH(history.ReplaceLastAction({}), "history.cc.*!empty");
  history.Append(1.0f, {0.5f, 0.25f}, push, /*limit=*/4);
  EXPECT_DEATH(history.observation(1), "history.cc.*i < size");
  EXPECT_DEATH(history.Append(1.0f, {0.5f}, push, /*limit=*/4), "history.cc");
}

TEST(BrokenContractTest, AnActionOfAnotherSpace) {
  ActionSpace space;
  space.n = 2;
  Action third;
  third.discrete = 2;
  std::vector<float> encoded(2);
  EXPECT_DEATH(space.Encode(third, absl::MakeSpan(encoded)), "action_space.cc");
}

}  // namespace
}  // namespace spikeserve
