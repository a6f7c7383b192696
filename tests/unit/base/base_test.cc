#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <optional>
#include <string>

#include "core/base/cbor.h"
#include "core/base/file.h"
#include "core/base/hex.h"
#include "core/base/printable.h"
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

}  // namespace
}  // namespace spikeserve
