#include "server/base/trace_parent.h"

#include <gtest/gtest.h>

#include <string>

namespace spikeserve {
namespace {

const std::string kTrace = "0af7651916cd43dd8448eb211c80319c";
const std::string kSpan = "b7ad6b7169203331";

TEST(TraceParentTest, ReadsIdsAndTheDecision) {
  const TraceParent parent = ParseTraceParent("00-" + kTrace + "-" + kSpan + "-01");
  EXPECT_TRUE(parent.is_valid());
  EXPECT_EQ(parent.trace_high, 0x0af7651916cd43ddU);
  EXPECT_EQ(parent.trace_low, 0x8448eb211c80319cU);
  EXPECT_EQ(parent.span, 0xb7ad6b7169203331U);
  EXPECT_TRUE(parent.sampled);
}

TEST(TraceParentTest, OnlyTheLowestFlagIsTheDecision) {
  EXPECT_FALSE(ParseTraceParent("00-" + kTrace + "-" + kSpan + "-fe").sampled);
  EXPECT_TRUE(ParseTraceParent("00-" + kTrace + "-" + kSpan + "-03").sampled);
}

TEST(TraceParentTest, ReadsLaterVersionsAsFarAsTheyAreKnown) {
  EXPECT_TRUE(ParseTraceParent("01-" + kTrace + "-" + kSpan + "-01").is_valid());
  EXPECT_TRUE(ParseTraceParent("01-" + kTrace + "-" + kSpan + "-01-more").is_valid());
  EXPECT_FALSE(ParseTraceParent("01-" + kTrace + "-" + kSpan + "-01more").is_valid());
}

TEST(TraceParentTest, RefusesWhatTheStandardCallsInvalid) {
  const std::string zeros(32, '0');
  for (const std::string& text : {
           std::string(),
           std::string("00"),
           "ff-" + kTrace + "-" + kSpan + "-01",
           "00-" + zeros + "-" + kSpan + "-01",
           "00-" + kTrace + "-" + zeros.substr(16) + "-01",
           "00-" + kTrace + "-" + kSpan + "-01-",
           "00-" + kTrace + "-" + kSpan + "-0",
           "00-" + kTrace + "-" + kSpan + "-0g",
           "00-" + kTrace + "_" + kSpan + "-01",
           "00-0AF7651916CD43DD8448EB211C80319C-" + kSpan + "-01",
           "0x-" + kTrace + "-" + kSpan + "-01",
       }) {
    EXPECT_FALSE(ParseTraceParent(text).is_valid()) << text;
  }
}

}  // namespace
}  // namespace spikeserve
