// Eligibility traces of the action head (eq. 4.1): the memory of which synapses were active
// together.
//
// A plain value and part of a session's; constant in size whatever the episode's length. Not
// thread-safe.
#ifndef CORE_LEARNING_ELIGIBILITY_TRACE_H_
#define CORE_LEARNING_ELIGIBILITY_TRACE_H_

#include <vector>

#include "absl/types/span.h"

namespace spikeserve {

struct EligibilityTrace {
  std::vector<float> values;  // [outputs of the action head, d], row-major

  // All zero.
  static EligibilityTrace Zeros(size_t outputs, size_t inputs) {
    return {.values = std::vector<float>(outputs * inputs, 0.0f)};
  }

  // E <- decay E + post (x) pre (eq. 4.1): `post` [outputs] is the head's side of the synapse,
  // `pre` [d] the readout rates. `decay` is lambda in [0, 1]. REQUIRES: values of [outputs, d].
  void Update(float decay, absl::Span<const float> post, absl::Span<const float> pre);

  // Forgets everything, as at the start of an episode.
  void Reset() { values.assign(values.size(), 0.0f); }

  // Frobenius norm.
  double Norm() const;

  friend bool operator==(const EligibilityTrace&, const EligibilityTrace&) = default;
};

// Of a matrix, in whatever order its values stand.
double FrobeniusNorm(absl::Span<const float> values);

}  // namespace spikeserve

#endif  // CORE_LEARNING_ELIGIBILITY_TRACE_H_
