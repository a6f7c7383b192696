// Fits a WiringModel to recorded episodes.
//
//   WiringFit fit(observation_size, action_size);
//   fit.Add(observations, actions);
//   absl::StatusOr<WiringModel> model = fit.Finish();
//
// Deterministic: the same episodes in the same order give the same numbers on every processor. Not
// thread-safe. Symbols: obs, act as in wiring_model.h.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/model/wiring_model.h"

namespace spikeserve {

class WiringFit {
 public:
  static constexpr size_t kMostSteps = 20'000;  // more data change little, and take time

  // REQUIRES: 1 <= observation_size.
  WiringFit(size_t observation_size, size_t action_size);

  // Adds an episode of T steps: `observations` [T + 1, obs] in environment units, of which the last
  // may be NaN, and `actions` [T, act] as ActionSpace::Encode writes them. Ignores steps above
  // kMostSteps.
  void Add(absl::Span<const float> observations, absl::Span<const float> actions);

  // FAILED_PRECONDITION if there are fewer steps than numbers to fit, or more than
  // WiringModel::kMostElements elements.
  absl::StatusOr<WiringModel> Finish() const;

 private:
  const size_t obs_;
  const size_t act_;
  // Of each step, both observations and the action.
  std::vector<double> before_, after_;  // [steps, obs]
  std::vector<float> actions_;          // [steps, act]
  std::vector<int64_t> longest_run_;    // [obs]
};

}  // namespace spikeserve
