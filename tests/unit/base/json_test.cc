#include "core/base/json.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "core/base/json_object.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;
using ::testing::StartsWith;

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

using nlohmann::json;

template <typename T, typename... Bounds>
std::string ErrorOf(const json& value, Bounds... bounds) {
  const json object = {{"key", value}};
  T result = {};
  JsonObject reader("object", object);
  reader.Required("key", &result, bounds...);
  return std::string(reader.Finish().message());
}

TEST(JsonObject, ReadsValuesOfEveryType) {
  const json object = json::parse(R"({"b": true, "i": -3, "u": 18446744073709551615, "d": 0.1,
      "s": "text", "v": [1, 2], "m": {"a": [0.5]}, "o": 7})");
  bool b = false;
  int i = 0;
  uint64_t u = 0;
  double d = 0.0;
  std::string s;
  std::vector<int> v;
  std::map<std::string, std::vector<float>> m;
  std::optional<int> o, absent;
  JsonObject reader("object", object);
  reader.Required("b", &b);
  reader.Required("i", &i);
  reader.Required("u", &u);
  reader.Required("d", &d);
  reader.Required("s", &s);
  reader.Required("v", &v);
  reader.Required("m", &m);
  reader.Optional("o", &o);
  reader.Optional("absent", &absent);
  ASSERT_TRUE(reader.Finish().ok()) << reader.status();
  EXPECT_TRUE(b);
  EXPECT_EQ(i, -3);
  EXPECT_EQ(u, UINT64_MAX);
  EXPECT_EQ(d, 0.1);
  EXPECT_EQ(s, "text");
  EXPECT_EQ(v, (std::vector<int>{1, 2}));
  EXPECT_EQ(m["a"], (std::vector<float>{0.5f}));
  EXPECT_EQ(o, 7);
  EXPECT_EQ(absent, std::nullopt);
}

TEST(JsonObject, EveryWrongValueIsNamed) {
  EXPECT_EQ(ErrorOf<bool>(1), "object.key: expected true or false, received 1");
  EXPECT_EQ(ErrorOf<std::string>(1), "object.key: expected a string, received 1");
  EXPECT_EQ(ErrorOf<double>("1"), "object.key: expected a number, received \"1\"");
  EXPECT_EQ(ErrorOf<float>(1e39),
            "object.key: expected a number that fits float32, received 1e+39");
  EXPECT_EQ(ErrorOf<std::vector<int>>(1), "object.key: expected an array, received 1");
  EXPECT_EQ(ErrorOf<std::vector<std::string>>({"a", 1}),
            "object.key[1]: expected a string, received 1");
  EXPECT_EQ(ErrorOf<std::vector<int>>({1, 2.5}),
            "object.key[1]: expected an integer from -2147483648 to 2147483647, received 2.5");
}

TEST(JsonObject, IntegersKeepTheirBounds) {
  EXPECT_EQ(ErrorOf<int>(0, 1, 9), "object.key: expected an integer from 1 to 9, received 0");
  EXPECT_EQ(ErrorOf<int>(10, 1, 9), "object.key: expected an integer from 1 to 9, received 10");
  EXPECT_EQ(ErrorOf<int>(9, 1, 9), "");
  EXPECT_EQ(ErrorOf<int>(1, 1, 9), "");
  EXPECT_EQ(ErrorOf<int64_t>(0, 1), "object.key: expected an integer of at least 1, received 0");
  EXPECT_EQ(ErrorOf<uint64_t>(-1), "object.key: expected an integer of at least 0, received -1");
  EXPECT_EQ(ErrorOf<int64_t>(UINT64_MAX),
            "object.key: expected an integer, received 18446744073709551615");
  EXPECT_EQ(ErrorOf<int64_t>(INT64_MIN), "");
}

TEST(JsonObject, MissingAndUnknownKeysAreErrors) {
  const json object = {{"a", 1}, {"b", 2}};
  int value = 0;
  JsonObject missing("object", object);
  missing.Required("c", &value);
  EXPECT_EQ(missing.Finish().message(), "object: expected key \"c\", received none");
  JsonObject unknown("object", object);
  unknown.Required("a", &value);
  EXPECT_EQ(unknown.Finish().message(), "object: expected no other keys, received \"b\"");
  JsonObject of_others("object", object);
  of_others.AllowOtherKeys();
  of_others.Required("a", &value);
  EXPECT_TRUE(of_others.Finish().ok());
  JsonObject array("object", json::array());
  EXPECT_EQ(array.Finish().message(), "object: expected an object, received an array of 0");
}

TEST(JsonObject, TheFirstErrorStaysAndNothingMoreIsRead) {
  const json object = {{"a", "x"}, {"b", 2}};
  int a = 0, b = 0;
  JsonObject reader("object", object);
  reader.Required("a", &a);
  reader.Required("b", &b);
  EXPECT_EQ(b, 0);
  EXPECT_EQ(reader.Finish().message(),
            "object.a: expected an integer from -2147483648 to 2147483647, received \"x\"");
}

}  // namespace
}  // namespace spikeserve
