#include "core/emit/table_text.h"

#include "absl/strings/str_format.h"

namespace spikeserve {
namespace {

constexpr size_t kWidth = 100;

// Returns the number with a point or an exponent, without which it would be an integer.
std::string Pointed(std::string number) {
  if (number.find_first_of(".e") == std::string::npos) number += ".0";
  return number;
}

}  // namespace

std::string CNumber(float number) { return Pointed(absl::StrFormat("%.9g", number)) + "f"; }
std::string CNumber(double number) { return Pointed(absl::StrFormat("%.17g", number)); }

std::string CArray(absl::string_view type, absl::string_view name,
                   absl::Span<const std::string> numbers) {
  std::string text =
      absl::StrCat("static const ", type, " ", name, "[", numbers.size(), "] = {\n    ");
  size_t column = 4;
  for (size_t i = 0; i < numbers.size(); ++i) {
    const bool is_last = i + 1 == numbers.size();
    if (column + numbers[i].size() + 1 > kWidth) {
      text += "\n    ";
      column = 4;
    }
    absl::StrAppend(&text, numbers[i], is_last ? "" : ",");
    column += numbers[i].size() + 1;
    if (is_last || column >= kWidth) continue;
    text += ' ';
    ++column;
  }
  return text + "};\n";
}

}  // namespace spikeserve
