#include "core/base/printable.h"

#include <cstdint>

#include "absl/strings/str_format.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

bool IsControl(uint32_t code) {
  const bool c0_or_c1 = code < 0x20 || (code >= 0x7f && code < 0xa0);
  const bool separator = code == 0x2028 || code == 0x2029;
  const bool directional = (code >= 0x202a && code <= 0x202e) || (code >= 0x2066 && code <= 0x2069);
  return c0_or_c1 || separator || directional;
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
