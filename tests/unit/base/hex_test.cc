#include "core/base/hex.h"

#include <gtest/gtest.h>

#include <optional>
#include <string>

namespace spikeserve {
namespace {

TEST(ParseHex, ReadsPairsOfDigits) {
  EXPECT_EQ(ParseHex(""), "");
  EXPECT_EQ(ParseHex("00fF7a"), std::string("\x00\xff\x7a", 3));
}

TEST(ParseHex, RefusesEverythingElse) {
  for (const char* text : {"0", "000", "0g", "g0", "-1", "+1", "0x", " 1", "1 "}) {
    EXPECT_EQ(ParseHex(text), std::nullopt) << text;
  }
}

}  // namespace
}  // namespace spikeserve
