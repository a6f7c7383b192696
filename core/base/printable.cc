#include "core/base/printable.h"

#include <algorithm>
#include <cstdint>
#include <iterator>

#include "absl/strings/str_format.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

struct Range {
  uint32_t first;
  uint32_t last;
};

// Controls, separators of lines, and what has no width or changes the direction (Unicode's general
// categories Cc, Zl, Zp and Cf). The joiners U+200C and U+200D stay: languages need them.
constexpr Range kControls[] = {{0x00, 0x1f},     {0x7f, 0x9f},     {0xad, 0xad},
                               {0x61c, 0x61c},   {0x180e, 0x180e}, {0x200b, 0x200b},
                               {0x200e, 0x200f}, {0x2028, 0x202e}, {0x2060, 0x206f},
                               {0xfeff, 0xfeff}, {0xfff9, 0xfffb}, {0xe0000, 0xe007f}};

bool IsControl(uint32_t code) {
  // Emscripten's library has no std::ranges::any_of.
  return std::any_of(std::begin(kControls), std::end(kControls), [code](const Range& range) {
    return code >= range.first && code <= range.last;
  });
}

// Returns the bytes of a character of UTF-8 by its first one, or 0.
size_t LengthOf(uint8_t first) {
  if (first < 0x80) return 1;
  if (first >= 0xc2 && first < 0xe0) return 2;
  if (first >= 0xe0 && first < 0xf0) return 3;
  return first >= 0xf0 && first < 0xf5 ? 4 : 0;
}

}  // namespace

Character FirstCharacter(absl::string_view text) {
  SPIKESERVE_DCHECK(!text.empty());
  const auto first = static_cast<uint8_t>(text[0]);
  const size_t length = LengthOf(first);
  if (length <= 1) return {.bytes = 1, .printable = length == 1 && !IsControl(first)};
  constexpr uint32_t kFirstBits[] = {0, 0, 0x1f, 0x0f, 0x07};
  constexpr uint32_t kSmallest[] = {0, 0, 0x80, 0x800, 0x10000};
  uint32_t code = first & kFirstBits[length];
  for (size_t i = 1; i < length; ++i) {
    if (i == text.size()) return {.bytes = 0, .printable = false};
    const auto byte = static_cast<uint8_t>(text[i]);
    if ((byte & 0xc0) != 0x80) return {.bytes = 1, .printable = false};
    code = code << 6 | (byte & 0x3f);
  }
  const bool surrogate = code >= 0xd800 && code < 0xe000;
  if (code < kSmallest[length] || code > 0x10ffff || surrogate) {
    return {.bytes = 1, .printable = false};
  }
  return {.bytes = length, .printable = !IsControl(code)};
}

bool IsPrintable(absl::string_view text) {
  while (!text.empty()) {
    const Character character = FirstCharacter(text);
    if (!character.printable) return false;
    text.remove_prefix(character.bytes);
  }
  return true;
}

void AppendEscaped(absl::string_view bytes, std::string* text) {
  for (const char byte : bytes) absl::StrAppendFormat(text, "\\u%04x", static_cast<uint8_t>(byte));
}

}  // namespace spikeserve
