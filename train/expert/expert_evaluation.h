// Plays an expert in its environment and summarises the returns.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "train/expert/expert.h"

namespace spikeserve {

// Plays `episodes` episodes, the i-th from Environment::Reset(first_seed + i), and returns their
// returns in this order. Uses one thread per core; the result does not depend on the number of
// threads. Returns INVALID_ARGUMENT if episodes < 1, NOT_FOUND for an unknown environment.
absl::StatusOr<std::vector<double>> EvaluateExpert(const Expert& expert,
                                                   const std::string& environment, int episodes,
                                                   uint64_t first_seed);

struct ReturnSummary {
  double mean = 0.0;
  double std = 0.0;  // population standard deviation: divided by n, not n - 1
};
// REQUIRES: at least one return.
ReturnSummary StatisticsOf(absl::Span<const double> returns);

}  // namespace spikeserve
