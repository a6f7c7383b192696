#include "server/base/log.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <string>

#include "absl/time/clock.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;
using ::testing::MatchesRegex;

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

TEST_F(LogTest, JsonHasTheSame) {
  SetLogFormat(LogFormat::kJson);
  const auto line = nlohmann::json::parse(Captured("policy refused", "no \"file\""));
  EXPECT_EQ(line["level"], "warning");
  EXPECT_EQ(line["message"], "policy refused");
  EXPECT_EQ(line["error"], "no \"file\"");
  EXPECT_THAT(line["time"].get<std::string>(), HasSubstr("T"));
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
