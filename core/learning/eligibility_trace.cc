#include "core/learning/eligibility_trace.h"

#include <cmath>

namespace spikeserve {

void EligibilityTrace::Update(float decay, absl::Span<const float> post,
                              absl::Span<const float> pre) {
  for (size_t i = 0; i < post.size(); ++i) {
    float* row = values.data() + i * pre.size();
    for (size_t j = 0; j < pre.size(); ++j) row[j] = decay * row[j] + post[i] * pre[j];
  }
}

double EligibilityTrace::Norm() const { return FrobeniusNorm(values); }

double FrobeniusNorm(absl::Span<const float> values) {
  double squares = 0.0;
  for (const float value : values) squares += static_cast<double>(value) * value;
  return std::sqrt(squares);
}

}  // namespace spikeserve
