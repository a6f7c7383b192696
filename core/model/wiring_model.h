// Predicts the next observation, to recognise sessions whose elements are wired otherwise than
// those of the training data (wiring_check.h in core/agent).
//
// With standardised elements z = (x - mean) / deviation and the encoded action u, the change of z
// is
//   z' - z = C^T [1, z, u, z_i z_j for i <= j, z_i u_k] + error.
// The errors of the elements are independent and have Student's t distributions with 4 degrees of
// freedom and the squared scales variance_i + growth_i g^3, where g is the mean of z_i^2: far from
// the mean, the quadratic prediction is worse.
//
// Plain values and pure functions; thread-safe. The numbers are float64, computed with + - * / and
// portable::Log in a fixed order, so that they have equal bits everywhere. Symbols: obs, act number
// of elements of an observation and of an encoded action.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/types/span.h"

namespace spikeserve {

struct WiringModel {
  // Larger observations have no model, because its size grows with the cube of obs.
  static constexpr size_t kMostElements = 32;

  std::vector<double> mean;          // [obs]
  std::vector<double> deviation;     // [obs], above 0
  std::vector<double> coefficients;  // C [Terms(obs, act), obs], row-major
  std::vector<double> variance;      // [obs], above 0
  std::vector<double> growth;        // [obs], at least 0
  std::vector<int64_t> longest_run;  // [obs]: most steps in a row without a change
  double usual_surprise = 0.0;       // 90 % of the steps of the training data have less

  static size_t Terms(size_t obs, size_t act) {
    return 1 + obs + act + obs * (obs + 1) / 2 + obs * act;
  }
  size_t size() const { return mean.size(); }
  double Standardise(double value, size_t element) const {
    return (value - mean[element]) / deviation[element];
  }

  // Writes the predicted change [obs] of the standardised observation `before` [obs] by `action`.
  // `terms` [Terms] is scratch memory.
  void Predict(absl::Span<const double> before, absl::Span<const float> action,
               absl::Span<double> terms, absl::Span<double> change) const;
  // Writes the derivatives of what Predict() writes, `slopes` [obs, obs]: a row for each element of
  // `before`.
  void FillSlopes(absl::Span<const double> before, absl::Span<const float> action,
                  absl::Span<double> slopes) const;
  struct Move {
    size_t element = 0;
    double by = 0.0;
  };
  // Adds to a predicted `change` [obs] what follows from moving elements of its `before`, which is
  // much less work than to predict again. `slopes` [obs, obs] are those of `change`. REQUIRES: the
  // elements ascend.
  void AddMoves(absl::Span<const double> slopes, absl::Span<const Move> moves,
                absl::Span<double> change) const;
  // Returns the surprise of a step from `before` to `after` [obs], standardised, where `change` was
  // predicted: -ln of its density without the constant part.
  double Surprise(absl::Span<const double> before, absl::Span<const double> after,
                  absl::Span<const double> change) const;
  // Returns how far the standardised observation `z` [obs] is from the training data: the product
  // of 1 + z_i^2 / 9.
  double Spread(absl::Span<const double> z) const;

  // Returns INVALID_ARGUMENT, which names the member, unless all sizes and numbers are valid.
  absl::Status Validate(int observation_size, int action_size) const;

  friend bool operator==(const WiringModel&, const WiringModel&) = default;
};

// Writes the terms of the equation.
void FillWiringTerms(absl::Span<const double> z, absl::Span<const float> action,
                     absl::Span<double> terms);

// A JSON object with the members above. Parsing a formatted model gives the same numbers.
absl::StatusOr<WiringModel> ParseWiringModel(absl::string_view json);
std::string FormatWiringModel(const WiringModel& model);

}  // namespace spikeserve
