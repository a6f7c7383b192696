#include "server/base/background_worker.h"

#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "absl/synchronization/notification.h"

namespace spikeserve {
namespace {

TEST(BackgroundWorkerTest, RunsWhatItAcceptedInOrderBeforeItEnds) {
  std::vector<int> ran;
  {
    BackgroundWorker worker(/*max_waiting=*/100);
    for (int i = 0; i < 50; ++i) {
      ASSERT_TRUE(worker.Submit([&ran, i] { ran.push_back(i); }).ok());
    }
  }
  ASSERT_EQ(ran.size(), 50u);
  for (int i = 0; i < 50; ++i) EXPECT_EQ(ran[static_cast<size_t>(i)], i);
}

TEST(BackgroundWorkerTest, GroupsTakeTurns) {
  absl::Notification started, go_on;
  std::string ran;
  {
    BackgroundWorker worker(/*max_waiting=*/3);
    ASSERT_TRUE(worker
                    .Submit([&] {
                      started.Notify();
                      go_on.WaitForNotification();
                    })
                    .ok());
    started.WaitForNotification();
    for (const std::string group : {"a", "a", "a", "b", "b", "c"}) {
      EXPECT_TRUE(worker.Submit(group, [&ran, group] { ran += group; }).ok());
    }
    EXPECT_EQ(worker.Submit("a", [] {}).code(), absl::StatusCode::kUnavailable);
    go_on.Notify();
  }
  EXPECT_EQ(ran, "abcaba");
}

TEST(BackgroundWorkerTest, RefusesWhatWouldPileUp) {
  absl::Notification started, go_on;
  int ran = 0;
  {
    BackgroundWorker worker(/*max_waiting=*/2);
    ASSERT_TRUE(worker
                    .Submit([&] {
                      started.Notify();
                      go_on.WaitForNotification();
                    })
                    .ok());
    started.WaitForNotification();  // the first task runs and no longer counts as waiting
    const auto count = [&ran] { ++ran; };
    EXPECT_TRUE(worker.Submit(count).ok());
    EXPECT_TRUE(worker.Submit(count).ok());
    EXPECT_EQ(worker.Submit(count).code(), absl::StatusCode::kUnavailable);
    go_on.Notify();
  }
  EXPECT_EQ(ran, 2);
}

}  // namespace
}  // namespace spikeserve
