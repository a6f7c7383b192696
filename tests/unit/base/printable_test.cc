#include "core/base/printable.h"

#include <gtest/gtest.h>

#include <string>

namespace spikeserve {
namespace {

TEST(IsPrintable, AcceptsTextsOfAllLanguages) {
  for (const char* text : {"", "arm 7", "Müller", "机器人", "\xf0\x9f\xa4\x96",
                           "\xd9\x85\xdb\x8c\xe2\x80\x8c\xd8\xae"}) {
    EXPECT_TRUE(IsPrintable(text)) << text;
  }
}

TEST(IsPrintable, RefusesWhatTerminalsObey) {
  for (const char* text :
       {"\x1b[2J", "a\rb", "a\nb", "\t", "\x7f",
        "\xc2\x9b"
        "2J",
        "\xe2\x80\xae"
        "abc",
        "\x9b"
        "2J",
        "\xff", "\xc3", "\xc0\x80", "\xed\xa0\x80", "\xf5\x80\x80\x80", "\xe2\x80\x8f",
        "\xe2\x80\x8b", "\xef\xbb\xbf", "\xd8\x9c", "\xc2\xad", "\xf3\xa0\x81\x81"}) {
    EXPECT_FALSE(IsPrintable(text)) << text;
  }
  EXPECT_FALSE(IsPrintable(std::string(1, '\0')));
}

TEST(AppendEscaped, WritesTheEscapesOfJson) {
  std::string text = "a";
  AppendEscaped("\x1b\xff", &text);
  EXPECT_EQ(text, "a\\u001b\\u00ff");
}

}  // namespace
}  // namespace spikeserve
