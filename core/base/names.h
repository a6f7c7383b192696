// Error texts about names that do not exist.
//
// Pure functions; thread-safe.
#pragma once

#include <string>
#include <vector>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the names that exist, separated by commas: all of them, or, if there are many, those that
// are most like `received`, and how many others there are. The text is short enough for a header.
std::string NamesLike(absl::string_view received, std::vector<std::string> known);

// Returns "; did you mean NAME?" if a name differs from `received` by a letter or two, or by the
// case of letters; otherwise an empty text.
std::string DidYouMean(absl::string_view received, const std::vector<std::string>& known);

}  // namespace spikeserve
