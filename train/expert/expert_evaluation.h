// Plays an expert in its environment.
#ifndef TRAIN_EXPERT_EXPERT_EVALUATION_H_
#define TRAIN_EXPERT_EXPERT_EVALUATION_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "train/expert/expert.h"

namespace spikeserve {

// The return of each of `episodes` episodes, which start from Environment::Reset(first_seed + i).
// Plays on as many threads as there are cores; the returns do not depend on it. INVALID_ARGUMENT
// if episodes < 1.
absl::StatusOr<std::vector<double>> EvaluateExpert(const Expert& expert,
                                                   const std::string& environment, int episodes,
                                                   uint64_t first_seed);

struct ReturnSummary {
  double mean = 0.0;
  double std = 0.0;  // divided by the number of episodes
};
// REQUIRES: at least one return.
ReturnSummary StatisticsOf(absl::Span<const double> returns);

}  // namespace spikeserve

#endif  // TRAIN_EXPERT_EXPERT_EVALUATION_H_
