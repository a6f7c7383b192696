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

class EligibilityTrace {
 public:
  EligibilityTrace() = default;
  // All zero; `outputs` rows of the action head, `inputs` columns (d).
  EligibilityTrace(int outputs, int inputs)
      : inputs_(inputs), values_(static_cast<size_t>(outputs) * inputs, 0.0f) {}

  // E <- decay E + post (x) pre (eq. 4.1): `post` [outputs] is the head's side of the synapse,
  // `pre` [inputs] the readout rates. `decay` is lambda in [0, 1].
  void Update(float decay, absl::Span<const float> post, absl::Span<const float> pre);

  // Forgets everything, as at the start of an episode.
  void Reset() { values_.assign(values_.size(), 0.0f); }

  // Frobenius norm.
  double Norm() const;

  absl::Span<const float> values() const { return values_; }  // [outputs, inputs], row-major

  friend bool operator==(const EligibilityTrace&, const EligibilityTrace&) = default;

 private:
  int inputs_ = 0;
  std::vector<float> values_;
};

}  // namespace spikeserve

#endif  // CORE_LEARNING_ELIGIBILITY_TRACE_H_
