// Writes the numbers of an integer policy as C tables, for the sources of core/emit/c.
//
// Pure functions, thread-safe.
#pragma once

#include <cstdint>
#include <string>
#include <type_traits>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"
#include "core/model/policy.h"

namespace spikeserve {

struct PolicyTables {
  std::string text;
  int64_t bytes = 0;  // of the numbers
};

// Returns the tables of the weights. REQUIRES: a spiking policy in integer arithmetic.
PolicyTables TablesOf(const Policy& policy);

// Returns the number as a C constant that is this number and no other one: "0.5f", "0.5".
std::string CNumber(float number);
std::string CNumber(double number);

// Returns "static const TYPE NAME[N] = {...};" with lines of at most 100 characters.
std::string CArray(absl::string_view type, absl::string_view name,
                   absl::Span<const std::string> numbers);

template <class Numbers>
std::string CTable(absl::string_view type, absl::string_view name, const Numbers& numbers) {
  std::vector<std::string> texts;
  for (const auto number : numbers) {
    if constexpr (std::is_floating_point_v<std::decay_t<decltype(number)>>) {
      texts.push_back(CNumber(number));
    } else {
      texts.push_back(
          absl::StrCat(+number, std::is_same_v<decltype(number), const uint32_t> ? "u" : ""));
    }
  }
  return CArray(type, name, texts);
}

}  // namespace spikeserve
