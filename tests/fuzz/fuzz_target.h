// The interface of a fuzz target: a function that takes any bytes, and good inputs to begin with.
//
// A target calls FUZZ_CHECK for what has to hold for every input. It is linked in two ways: with
// libFuzzer, which searches for inputs (`make fuzz`), and with replay_main.cc, which replays the
// seeds and the inputs that once failed (every `make test`).
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Runs the target on one input. Ends the process if a check fails.
void FuzzOne(absl::string_view input);

// Returns valid inputs.
std::vector<std::string> Seeds();

// Ends the process; see FUZZ_CHECK.
[[noreturn]] inline void FuzzCheckFailed(const char* file, int line, const char* condition) {
  std::fprintf(stderr, "%s:%d: expected %s\n", file, line, condition);
  std::abort();
}

// Reads numbers from an input, and zeros after its end.
class InputReader {
 public:
  explicit InputReader(absl::string_view input) : rest_(input) {}

  bool empty() const { return rest_.empty(); }
  absl::string_view rest() const { return rest_; }

  uint8_t Byte() {
    if (rest_.empty()) return 0;
    const auto byte = static_cast<uint8_t>(rest_.front());
    rest_.remove_prefix(1);
    return byte;
  }
  // Returns at most `length` bytes.
  absl::string_view Bytes(size_t length) {
    const absl::string_view bytes = rest_.substr(0, length);
    rest_.remove_prefix(bytes.size());
    return bytes;
  }

 private:
  absl::string_view rest_;
};

}  // namespace spikeserve

#define FUZZ_CHECK(condition) \
  ((condition) ? void() : spikeserve::FuzzCheckFailed(__FILE__, __LINE__, #condition))
