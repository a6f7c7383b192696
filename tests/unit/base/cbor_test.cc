#include "core/base/cbor.h"

#include <gtest/gtest.h>

#include <string>

namespace spikeserve {
namespace {

using Json = nlohmann::json;

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

}  // namespace
}  // namespace spikeserve
