#include "core/base/json.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>

namespace spikeserve {
namespace {

using testing::HasSubstr;
using testing::StartsWith;

std::string Repeat(const std::string& text, int times) {
  std::string all;
  for (int i = 0; i < times; ++i) all += text;
  return all;
}

TEST(ParseJsonObject, TakesAnObjectWithWhiteSpaceAround) {
  const auto object = ParseJsonObject("config", " {\"a\": {\"b\": 1}, \"c\": {\"b\": 2}}\n ");
  ASSERT_TRUE(object.ok()) << object.status();
  EXPECT_EQ((*object)["c"]["b"], 2);
}

TEST(ParseJsonObject, RefusesWhatIsNotStrict) {
  const struct {
    std::string text;
    std::string fragment;
  } cases[] = {
      {"", "valid JSON in UTF-8"},
      {"{", "valid JSON in UTF-8, received an error at byte 2"},
      {"{\"a\": 01}", "valid JSON in UTF-8"},
      {"{\"a\": NaN}", "valid JSON in UTF-8"},
      {"{\"a\": 1e999}", "valid JSON in UTF-8"},
      {"{\"a\": 1,}", "valid JSON in UTF-8"},
      {"{} // comment", "valid JSON in UTF-8"},
      {"{}{}", "valid JSON in UTF-8"},
      {"{\"a\": \"\xff\"}", "valid JSON in UTF-8"},
      {std::string("{}\0{}", 5), "a zero byte at byte 3"},
      {"[]", "a JSON object, received an array of 0"},
      {"\"text\"", "a JSON object, received \"text\""},
      {"{\"a\": 1, \"a\": 1}", "every key once, received \"a\" twice"},
      {"{\"a\": 1, \"\\u0061\": 1}", "every key once, received \"a\" twice"},
      {"{\"x\": [{\"b\": {}, \"b\": {}}]}", "every key once, received \"b\" twice"},
      {"{\"a\": " + Repeat("[", 100000), "at most 32 levels"},
      {Repeat("{\"a\":", 100000), "at most 32 levels"},
      {"{\"a\": [0" + Repeat(",0", 1'000'000) + "]}", "at most 1000000 values"},
  };
  for (const auto& c : cases) {
    const absl::Status status = ParseJsonObject("config", c.text).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << c.fragment;
    EXPECT_THAT(std::string(status.message()), StartsWith("config: expected "));
    EXPECT_THAT(std::string(status.message()), HasSubstr(c.fragment));
  }
}

TEST(ParseJsonObject, TakesTheDeepestThatIsAllowed) {
  const std::string text = "{\"a\": " + Repeat("[", 31) + Repeat("]", 31) + "}";
  EXPECT_TRUE(ParseJsonObject("config", text).ok());
}

TEST(Quoted, IsShortAscii) {
  EXPECT_EQ(Quoted("head.weight"), "\"head.weight\"");
  EXPECT_EQ(Quoted("a\nb\xff"), "\"a\\nb\\xff\"");
  EXPECT_EQ(Quoted(std::string(1000, 'x')), "\"" + std::string(80, 'x') + "...\"");
}

TEST(Describe, NamesWhatIsLongAndShowsWhatIsShort) {
  EXPECT_EQ(Describe(nlohmann::json::object()), "an object");
  EXPECT_EQ(Describe({1, 2}), "an array of 2");
  EXPECT_EQ(Describe("x"), "\"x\"");
  EXPECT_EQ(Describe(1.5), "1.5");
  EXPECT_EQ(Describe(nullptr), "null");
}

}  // namespace
}  // namespace spikeserve
