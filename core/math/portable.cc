#include "core/math/portable.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "core/contract/dcheck.h"

namespace spikeserve::portable {
namespace {

// ln 2 in two parts. The first has 32 zero bits at its end, so that its product with the exponent
// of a float64 number is exact.
constexpr double kLn2High = 6.93147180369123816490e-01;
constexpr double kLn2Low = 1.90821492927058770002e-10;

// Sums of Taylor's series: cos x and sin x for 0 <= x <= pi / 4.
double CosSeries(double x) {
  double sum = 1.0;
  for (int n = 18; n >= 2; n -= 2) sum = 1.0 - sum * (x * x / (n * (n - 1)));
  return sum;
}

double SinSeries(double x) {
  double sum = 1.0;
  for (int n = 19; n >= 3; n -= 2) sum = 1.0 - sum * (x * x / (n * (n - 1)));
  return sum * x;
}

// From here on, the continued fraction replaces the series.
constexpr double kTail = 2.0;

// Returns ln(1 - Phi(x)) by Laplace's continued fraction. REQUIRES: x >= kTail.
double LogTail(double x) {
  constexpr int kDepth = 100;
  constexpr double kLogSqrtTwoPi = 0.91893853320467274178;
  double fraction = x;
  for (int n = kDepth; n >= 1; --n) fraction = x + n / fraction;
  return -0.5 * x * x - kLogSqrtTwoPi - Log(fraction);
}

}  // namespace

double Log(double x) {
  if (x == 0.0) return -std::numeric_limits<double>::infinity();
  if (!(x > 0.0)) return std::numeric_limits<double>::quiet_NaN();
  if (std::isinf(x)) return x;
  int exponent = 0;
  double significand = std::frexp(x, &exponent);
  if (significand < 0.5 * std::numbers::sqrt2) {
    significand *= 2.0;
    --exponent;
  }
  // ln(1 + f) = 2 artanh(s) = f - f^2/2 + s (f^2/2 + r), where r is the series of artanh from its
  // second term on. The sum is in the order of fdlibm, which loses no bits for small f.
  const double f = significand - 1.0;
  const double s = f / (2.0 + f);
  double r = 0.0;
  for (int n = 25; n >= 3; n -= 2) r = (r + 2.0 / n) * (s * s);
  const double half = 0.5 * f * f;
  return exponent * kLn2High - ((half - (s * (half + r) + exponent * kLn2Low)) - f);
}

double Exp(double x) {
  constexpr double kLargest = 709.79;    // e^x overflows above
  constexpr double kSmallest = -745.14;  // e^x is 0 below
  if (std::isnan(x)) return x;
  if (x > kLargest) return std::numeric_limits<double>::infinity();
  if (x < kSmallest) return 0.0;
  const double n = std::floor(x * std::numbers::log2e + 0.5);
  const double r = (x - n * kLn2High) - n * kLn2Low;
  double sum = 1.0;
  for (int k = 14; k >= 1; --k) sum = 1.0 + sum * (r / k);
  return std::ldexp(sum, static_cast<int>(n));
}

double CosOfTurns(double turns) {
  SPIKESERVE_DCHECK(std::abs(turns) <= 0x1p50);
  constexpr double kTwoPi = 2.0 * std::numbers::pi;
  // Each reduction is exact: to half a turn, to a quarter, and to an eighth.
  double part = std::abs(turns - std::floor(turns + 0.5));
  const double sign = part > 0.25 ? -1.0 : 1.0;
  if (part > 0.25) part = 0.5 - part;
  return sign * (part > 0.125 ? SinSeries(kTwoPi * (0.25 - part)) : CosSeries(kTwoPi * part));
}

double Hypot(double x, double y) {
  if (std::isnan(x) || std::isnan(y)) return std::numeric_limits<double>::quiet_NaN();
  const double large = std::max(std::abs(x), std::abs(y));
  if (large == 0.0 || std::isinf(large)) return large;
  const double ratio = std::min(std::abs(x), std::abs(y)) / large;
  return large * std::sqrt(1.0 + ratio * ratio);
}

double LogNormalDistribution(double z) {
  if (z < -kTail) return LogTail(-z);
  if (z > kTail) return Log(1.0 - Exp(LogTail(z)));
  // Phi(z) = 1/2 + phi(z) (z + z^3/3 + z^5/(3*5) + ...)
  double sum = 0.0;
  for (int n = 61; n >= 1; n -= 2) sum = (1.0 + sum) * (z * z / (n + 2));
  constexpr double kSqrtTwoPi = 2.50662827463100050242;
  return Log(0.5 + Exp(-0.5 * z * z) / kSqrtTwoPi * (z * (1.0 + sum)));
}

}  // namespace spikeserve::portable
