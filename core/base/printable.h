// Texts that others have sent, as texts that a terminal shows and does not obey.
//
// Pure functions; thread-safe.
#pragma once

#include <cstddef>
#include <string>

#include "absl/strings/string_view.h"

namespace spikeserve {

// One character at the beginning of a text.
struct Character {
  size_t bytes = 1;        // of the text; 0: the text ends within a character
  bool printable = false;  // false for what is not shown, and bytes of no UTF-8
};

// Returns the first character. REQUIRES: a text that is not empty.
Character FirstCharacter(absl::string_view text);

// Returns whether every character is printable. Line feeds and tabs are not.
bool IsPrintable(absl::string_view text);

// Appends these bytes, as \u001b: the escapes of JSON, so that a text in JSON stays one.
void AppendEscaped(absl::string_view bytes, std::string* text);

}  // namespace spikeserve
