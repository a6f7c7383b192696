// Checks of what headers require of their callers ("REQUIRES: ..."). They run in builds without
// NDEBUG (the presets debug, asan, tsan and fuzz) and are compiled, but not evaluated, in release
// builds.
//
//   SPIKESERVE_DCHECK(!done());
//   SPIKESERVE_DCHECK_EQ(observation.size(), space.size());
//
// A failed check prints the file, the line, the expression and the values, and aborts the process,
// because only a mistake in this program can fail it. Input from outside is never checked here: it
// gets an absl::Status.
//
// Thread-safety: may be used on any thread.
#pragma once

#include <string>
#include <type_traits>

#include "absl/base/optimization.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

#ifdef NDEBUG
inline constexpr bool kDChecks = false;
#else
inline constexpr bool kDChecks = true;
#endif

// Prints "FILE:LINE: check failed: EXPRESSION DETAILS" on standard error and aborts.
[[noreturn]] void FailDCheck(absl::string_view file, int line, absl::string_view expression,
                             absl::string_view details);

// Returns "(A vs. B)" for the values of a failed comparison, or nothing if they cannot be printed.
template <typename A, typename B>
std::string ComparedValues(const A& a, const B& b) {
  if constexpr (std::is_arithmetic_v<A> && std::is_arithmetic_v<B>) {
    return absl::StrCat("(", a, " vs. ", b, ")");
  } else {
    return "";
  }
}

}  // namespace spikeserve

#define SPIKESERVE_DCHECK(condition)                                            \
  do {                                                                          \
    if (::spikeserve::kDChecks && ABSL_PREDICT_FALSE(!(condition))) {           \
      ::spikeserve::FailDCheck(__FILE__, __LINE__, #condition, /*details=*/""); \
    }                                                                           \
  } while (false)

// Evaluates each argument once.
#define SPIKESERVE_DCHECK_COMPARED(a, op, b)                                        \
  do {                                                                              \
    if constexpr (::spikeserve::kDChecks) {                                         \
      const auto& dcheck_a = (a);                                                   \
      const auto& dcheck_b = (b);                                                   \
      if (ABSL_PREDICT_FALSE(!(dcheck_a op dcheck_b))) {                            \
        ::spikeserve::FailDCheck(__FILE__, __LINE__, #a " " #op " " #b,             \
                                 ::spikeserve::ComparedValues(dcheck_a, dcheck_b)); \
      }                                                                             \
    }                                                                               \
  } while (false)

#define SPIKESERVE_DCHECK_EQ(a, b) SPIKESERVE_DCHECK_COMPARED(a, ==, b)
#define SPIKESERVE_DCHECK_LT(a, b) SPIKESERVE_DCHECK_COMPARED(a, <, b)
#define SPIKESERVE_DCHECK_LE(a, b) SPIKESERVE_DCHECK_COMPARED(a, <=, b)
#define SPIKESERVE_DCHECK_GT(a, b) SPIKESERVE_DCHECK_COMPARED(a, >, b)
#define SPIKESERVE_DCHECK_GE(a, b) SPIKESERVE_DCHECK_COMPARED(a, >=, b)
