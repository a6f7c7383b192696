// Numbers as texts show them.
//
// A pure function; thread-safe.
#pragma once

#include <cmath>

namespace spikeserve {

// Returns `value` rounded to this many decimals; what rounds to nothing is 0 without a sign,
// because "lost -0.00 %" reads like a loss.
inline double Rounded(double value, int decimals) {
  double scale = 1.0;
  for (int i = 0; i < decimals; ++i) scale *= 10.0;
  return std::round(value * scale) / scale + 0.0;  // -0 + 0 is 0
}

}  // namespace spikeserve
