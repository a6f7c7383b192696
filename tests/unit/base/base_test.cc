#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "core/base/cbor.h"
#include "core/base/file.h"
#include "core/base/hex.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/printable.h"
#include "nlohmann/json.hpp"
#include "tests/support/files.h"

namespace spikeserve {
namespace {

using ::testing::StartsWith;
using Json = nlohmann::json;

using AtomicFileTest = DirectoryTest;

size_t FilesIn(const std::filesystem::path& directory) {
  return std::distance(std::filesystem::directory_iterator(directory), {});
}

TEST_F(AtomicFileTest, ReplacesTheFileAndLeavesNothingElse) {
  WriteBytes(Path("file"), "a longer old text");
  ASSERT_TRUE(WriteFileAtomically(Path("file"), {"new ", "", "text"}).ok());
  EXPECT_EQ(ReadBytes(Path("file")), "new text");
  EXPECT_EQ(FilesIn(directory()), 1u);
}

TEST_F(AtomicFileTest, EverybodyMayReadTheFile) {
  ASSERT_TRUE(WriteFileAtomically(Path("file"), {"text"}).ok());
  EXPECT_EQ(std::filesystem::status(Path("file")).permissions(),
            static_cast<std::filesystem::perms>(0644));
}

TEST_F(AtomicFileTest, ADirectoryThatIsNotThereIsAnError) {
  const std::string path = Path("nowhere") + "/file";
  const absl::Status status = WriteFileAtomically(path, {"text"});
  EXPECT_EQ(status.code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(status.message()), StartsWith(path + ": cannot create"));
}

TEST_F(AtomicFileTest, AFailedRenameLeavesNothingBehind) {
  std::filesystem::create_directory(Path("taken"));
  const absl::Status status = WriteFileAtomically(Path("taken"), {"text"});
  EXPECT_FALSE(status.ok());
  EXPECT_THAT(std::string(status.message()), StartsWith(Path("taken") + ": cannot rename"));
  EXPECT_EQ(FilesIn(directory()), 1u);
}

std::string Cbor(const Json& json) {
  std::string bytes;
  Json::to_cbor(json, bytes);
  return bytes;
}

TEST(ParseCbor, ReadsWhatWasWritten) {
  const Json json = {{"name", "r\u00f6bot"}, {"values", {1, -2, 0.5, nullptr, true}}};
  EXPECT_EQ(ParseCbor(Cbor(json)), json);
}

TEST(ParseCbor, RefusesEverythingElse) {
  const std::string array_of_2_to_61("\x9b\x20\0\0\0\0\0\0\0", 9);
  const std::string map_of_2_to_61("\xbb\x20\0\0\0\0\0\0\0", 9);
  const std::string bytes_of_2_to_61("\x5b\x20\0\0\0\0\0\0\0", 9);
  const struct {
    const char* name;
    std::string bytes;
  } cases[] = {
      {"nothing", ""},
      {"an array longer than the input", array_of_2_to_61},
      {"a map longer than the input", map_of_2_to_61},
      {"a byte string longer than the input", bytes_of_2_to_61},
      {"the same inside an array", "\x82\x01" + array_of_2_to_61},
      {"deep nesting", std::string(1'000'000, '\x81')},
      {"deep nesting without lengths", std::string(1'000'000, '\x9f')},
      {"something after the value", Cbor(1) + "x"},
      {"a text that is not UTF-8", "\x61\xff"},
      {"a key that is not UTF-8", "\xa1\x61\xff\x01"},
      {"a reserved byte", "\x1c"},
  };
  for (const auto& c : cases) EXPECT_FALSE(ParseCbor(c.bytes).has_value()) << c.name;
}

TEST(ParseCbor, ReadsTheDeepestThatIsAllowed) {
  const auto nested = [](int depth) { return std::string(depth, '\x81') + '\x01'; };
  EXPECT_TRUE(ParseCbor(nested(kMaxCborDepth)).has_value());
  EXPECT_FALSE(ParseCbor(nested(kMaxCborDepth + 1)).has_value());
}

TEST(ParseHex, ReadsPairsOfDigits) {
  EXPECT_EQ(ParseHex(""), "");
  EXPECT_EQ(ParseHex("00fF7a"), std::string("\x00\xff\x7a", 3));
}

TEST(ParseHex, RefusesEverythingElse) {
  for (const char* text : {"0", "000", "0g", "g0", "-1", "+1", "0x", " 1", "1 "}) {
    EXPECT_EQ(ParseHex(text), std::nullopt) << text;
  }
}

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

using ::testing::HasSubstr;

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
