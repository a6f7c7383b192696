#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <string>
#include <vector>

#include "absl/synchronization/notification.h"
#include "absl/time/clock.h"
#include "server/base/background_worker.h"
#include "server/base/log.h"
#include "server/base/shared_places.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;
using ::testing::MatchesRegex;

TEST(BackgroundWorkerTest, GroupsTakeTurnsInTheirOrder) {
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
    for (const std::string work : {"a1 ", "a2 ", "a3 ", "b1 ", "b2 ", "c1 "}) {
      EXPECT_TRUE(worker.Submit(work.substr(0, 1), [&ran, work] { ran += work; }).ok());
    }
    EXPECT_EQ(worker.Submit("a", [] {}).code(), absl::StatusCode::kUnavailable);
    go_on.Notify();
  }
  EXPECT_EQ(ran, "a1 b1 c1 a2 b2 a3 ");
}

using Places = std::vector<std::shared_ptr<SharedPlaces::Place>>;

// Takes places until there is none for the group. Returns how many.
size_t TakeAll(SharedPlaces& places, const std::string& group, Places* taken) {
  const size_t before = taken->size();
  while (auto place = places.Take(group)) taken->push_back(std::move(place));
  return taken->size() - before;
}

TEST(SharedPlacesTest, EachGroupLeavesRoomForAnother) {
  SharedPlaces places(16);
  Places taken;
  EXPECT_EQ(TakeAll(places, "first", &taken), 8u);
  EXPECT_EQ(TakeAll(places, "second", &taken), 4u);
  EXPECT_EQ(TakeAll(places, "third", &taken), 2u);
  EXPECT_EQ(TakeAll(places, "first", &taken), 0u);
}

TEST(SharedPlacesTest, PlacesAreGivenBack) {
  SharedPlaces places(16);
  for (int i = 0; i < 3; ++i) {
    Places taken;
    EXPECT_EQ(TakeAll(places, "first", &taken), 8u);
  }
}

TEST(SharedPlacesTest, PlacesMayOutliveTheObject) {
  std::shared_ptr<SharedPlaces::Place> place;
  {
    SharedPlaces places(2);
    place = places.Take("a");
  }
  EXPECT_NE(place, nullptr);
}

class LogTest : public testing::Test {
 protected:
  ~LogTest() override { SetLogFormat(LogFormat::kText); }

  static std::string Captured(absl::string_view message, absl::string_view value) {
    testing::internal::CaptureStderr();
    LogWarning(message, {{"error", value}});
    return testing::internal::GetCapturedStderr();
  }
};

TEST_F(LogTest, TextHasTimeLevelMessageAndFields) {
  EXPECT_THAT(Captured("policy refused", "no such file"),
              MatchesRegex("[0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2}\\.[0-9]{3}Z "
                           "warning policy refused error=\"no such file\"\n"));
}

// A value from the wire must not forge a line, reach a terminal or break the line's encoding.
TEST_F(LogTest, ValuesAreEscapedInBothFormats) {
  const std::string hostile = "a\nforged \x1b[31m\"}\xff{}";
  for (const LogFormat format : {LogFormat::kText, LogFormat::kJson}) {
    SetLogFormat(format);
    const std::string line = Captured("refused", hostile);
    EXPECT_THAT(line, HasSubstr("a\\nforged \\u001b[31m\\\"}\\ufffd{}"));
    EXPECT_EQ(line.find('\n'), line.size() - 1) << line;
    for (const char c : line.substr(0, line.size() - 1)) EXPECT_TRUE(c >= ' ' && c <= '~') << line;
  }
}

TEST_F(LogTest, AFloodOfOneKindIsCut) {
  testing::internal::CaptureStderr();
  for (int i = 0; i < 1000; ++i) LogWarning("flood", {{"number", std::to_string(i)}});
  LogError("flood");  // another kind
  const std::string lines = testing::internal::GetCapturedStderr();
  const auto count = std::count(lines.begin(), lines.end(), '\n');
  EXPECT_GT(count, kMostLinesPerSecond);
  EXPECT_LE(count, 3 * kMostLinesPerSecond);  // a busy machine may need more than a second
  EXPECT_THAT(lines, HasSubstr("error flood\n"));
}

TEST_F(LogTest, ALineSaysHowManyWereLeftOut) {
  testing::internal::CaptureStderr();
  const absl::Time end = absl::Now() + absl::Seconds(30);
  std::string lines;
  while (lines.find("suppressed=") == std::string::npos && absl::Now() < end) {
    for (int i = 0; i < 100; ++i) LogWarning("left out");
    lines += testing::internal::GetCapturedStderr();
    testing::internal::CaptureStderr();
  }
  testing::internal::GetCapturedStderr();
  EXPECT_THAT(lines, HasSubstr("warning left out suppressed=\""));
}

}  // namespace
}  // namespace spikeserve
