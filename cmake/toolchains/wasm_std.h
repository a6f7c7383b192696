// Defines what core uses of C++20 and the C++ library of Debian's emscripten lacks. Every source
// for WebAssembly includes it.
#pragma once

#include <cerrno>
#include <charconv>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <string_view>
#include <version>

#ifndef __cpp_lib_bit_cast
namespace std {

template <class To, class From>
constexpr To bit_cast(const From& from) noexcept {
  return __builtin_bit_cast(To, from);
}

// Writes digits that parse to the same number, which need not be the fewest. REQUIRES: 16
// characters.
inline to_chars_result to_chars(char* first, char* last, float number) {
  return {first + snprintf(first, static_cast<size_t>(last - first), "%.9g", number), errc()};
}

// Reads a decimal number. strtof() would also read spaces, a plus, hexadecimal digits and words.
inline from_chars_result from_chars(const char* first, const char* last, float& number) {
  const string_view all(first, static_cast<size_t>(last - first));
  const string text(all.substr(0, all.find_first_not_of("0123456789.eE+-")));
  if (text.empty() || text[0] == '+') return {first, errc::invalid_argument};
  char* end = nullptr;
  errno = 0;
  const float value = strtof(text.c_str(), &end);
  if (end == text.c_str()) return {first, errc::invalid_argument};
  const char* const rest = first + (end - text.c_str());
  if (errno == ERANGE) return {rest, errc::result_out_of_range};
  number = value;
  return {rest, errc()};
}

}  // namespace std
#endif
