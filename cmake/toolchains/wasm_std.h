// Defines what core uses of C++20 and the C++ library of Debian's emscripten lacks. Every source
// for WebAssembly includes it.
#ifndef CMAKE_TOOLCHAINS_WASM_STD_H_
#define CMAKE_TOOLCHAINS_WASM_STD_H_

#include <charconv>
#include <cstdio>
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

}  // namespace std
#endif

#endif  // CMAKE_TOOLCHAINS_WASM_STD_H_
