// What the test of a session's wiring (wiring_check.h in core/agent) remembers between two steps.
// Nothing while the steps are usual: a state that is equal to WiringState() is not stored.
//
// Plain values; not thread-safe.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "core/base/enum_names.h"

namespace spikeserve {

enum class WiringCause { kExchanged, kSign, kUnit, kStuck, kDelay, kDynamics };
inline constexpr size_t kWiringCauses = 6;

// Names in metrics, on pages and in stored sessions.
constexpr std::array<EnumName<WiringCause>, kWiringCauses> EnumNames(WiringCause) {
  return {{{WiringCause::kExchanged, "exchanged"},
           {WiringCause::kSign, "sign"},
           {WiringCause::kUnit, "unit"},
           {WiringCause::kStuck, "stuck"},
           {WiringCause::kDelay, "delay"},
           {WiringCause::kDynamics, "dynamics"}}};
}

struct WiringVerdict {
  WiringCause cause = WiringCause::kDynamics;
  std::vector<int> elements;  // indices, from 0
  double evidence = 0.0;      // ln of the likelihood ratio to a correct wiring; 0 for kStuck

  friend bool operator==(const WiringVerdict&, const WiringVerdict&) = default;
};

// A wiring that may explain the observations better than that of the training data.
struct WiringHypothesis {
  uint16_t number = 0;    // of WiringOf() in wiring_step.h
  float evidence = 0.0f;  // not negative
  float total = 0.0f;     // ln of the likelihood ratio since the window began

  friend bool operator==(const WiringHypothesis&, const WiringHypothesis&) = default;
};

struct WiringState {
  bool is_open = false;                      // a window is open, whose state follows
  int64_t steps = 0;                         // of the window
  double unusual = 0.0;                      // evidence for other dynamics, or for a window
  std::vector<WiringHypothesis> hypotheses;  // by number, without those that were given up
  std::vector<int64_t> runs;  // [obs], steps in which an element has not changed; empty: all are 0
  std::optional<WiringVerdict> verdict;

  friend bool operator==(const WiringState&, const WiringState&) = default;
};

}  // namespace spikeserve
