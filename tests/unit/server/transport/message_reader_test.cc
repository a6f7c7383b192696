#include "server/transport/message_reader.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;

constexpr size_t kLimit = 300;

std::string Frame(const std::string& message) {
  std::string prefix(5, '\0');
  prefix[3] = static_cast<char>(message.size() >> 8);
  prefix[4] = static_cast<char>(message.size());
  return prefix + message;
}

// Passes `bytes` to `reader`, `step` at a time, and returns the messages, or "too long: LENGTH".
std::vector<std::string> Read(const std::string& bytes, size_t step, MessageReader* reader) {
  std::vector<std::string> messages;
  for (size_t i = 0; i < bytes.size(); i += step) {
    absl::string_view data = absl::string_view(bytes).substr(i, step);
    while (true) {
      const auto item = reader->Next(&data, kLimit);
      if (!item.has_value()) break;
      messages.push_back(item->too_long ? absl::StrCat("too long: ", item->length)
                                        : std::string(item->message));
    }
    EXPECT_TRUE(data.empty());
  }
  return messages;
}

TEST(MessageReaderTest, SplitsAnyWay) {
  const std::string long_message(kLimit, 'x');
  const std::string bytes = Frame("one") + Frame("") + Frame(long_message) + Frame("two");
  for (size_t step = 1; step <= bytes.size(); ++step) {
    MessageReader reader;
    EXPECT_THAT(Read(bytes, step, &reader), ElementsAre("one", "", long_message, "two")) << step;
    EXPECT_TRUE(reader.at_boundary());
    EXPECT_EQ(reader.buffered(), 0);
  }
}

TEST(MessageReaderTest, DropsWhatIsTooLong) {
  const std::string bytes = Frame("one") + Frame(std::string(kLimit + 1, 'x')) + Frame("two");
  for (size_t step = 1; step <= bytes.size(); ++step) {
    MessageReader reader;
    EXPECT_THAT(Read(bytes, step, &reader), ElementsAre("one", "too long: 301", "two")) << step;
    EXPECT_TRUE(reader.at_boundary());
  }
}

TEST(MessageReaderTest, StoresOnlyAnIncompleteMessage) {
  MessageReader reader;
  EXPECT_THAT(Read(Frame("one") + Frame("two").substr(0, 6), 100, &reader), ElementsAre("one"));
  EXPECT_EQ(reader.buffered(), 6);
  EXPECT_FALSE(reader.at_boundary());
}

TEST(MessageReaderTest, StoresNothingOfAMessageThatIsTooLong) {
  MessageReader reader;
  const std::string begin = Frame(std::string(kLimit + 1, 'x')).substr(0, 200);
  EXPECT_THAT(Read(begin, 7, &reader), ElementsAre("too long: 301"));
  EXPECT_EQ(reader.buffered(), 0);
  EXPECT_FALSE(reader.at_boundary());
}

TEST(MessageReaderTest, SaysWhetherAMessageIsCompressed) {
  MessageReader reader;
  absl::string_view data("\x01\0\0\0\1x\0\0\0\0\0", 11);
  EXPECT_TRUE(reader.Next(&data, kLimit)->compressed);
  EXPECT_FALSE(reader.Next(&data, kLimit)->compressed);
}

}  // namespace
}  // namespace spikeserve
