// Elementary functions in float64 with equal bits on every processor.
//
// The C library's functions differ in their last bits between processors and versions. What decides
// (an action that is drawn, a learner's guard, the evidence of a roll-out) uses the functions
// below. They consist of + - * / and sqrt, which IEEE 754 rounds in one way, in a fixed order; the
// build fuses none of them. All are pure and thread-safe.
#pragma once

namespace spikeserve::portable {

// Returns ln x to within 1 unit in the last place; -inf for 0, NaN for negative numbers.
double Log(double x);

// Returns e^x to within 2 units in the last place of a normal result.
double Exp(double x);

// Returns cos(2 pi turns) to within 2^-52. REQUIRES: |turns| <= 2^50.
double CosOfTurns(double turns);

// Returns sqrt(x^2 + y^2) to within 2 units in the last place, without overflow of the squares; NaN
// if x or y is NaN.
double Hypot(double x, double y);

// Returns ln Phi(z), the logarithm of the normal distribution function, to within 1e-13 relative to
// max(1, |result|).
double LogNormalDistribution(double z);

}  // namespace spikeserve::portable
