// NumPy's default random generator, bit for bit: numpy.random.default_rng(seed).
//
// The seed is spread by SeedSequence (M. E. O'Neill's seed_seq_fe128: "Developing a seed_seq
// Alternative", 2015; NumPy: numpy/random/bit_generator.pyx), the bits come from PCG64, the 128-bit
// linear congruential generator with XSL-RR output (M. E. O'Neill, "PCG: A Family of Simple Fast
// Space-Efficient Statistically Good Algorithms for Random Number Generation", HMC-CS-2014-0905;
// NumPy: numpy/random/src/pcg64), and Uniform is Generator.uniform. NumPy's compatibility policy
// (NEP 19) keeps the streams of SeedSequence and PCG64 as they are.
//
// A value: copying it forks the stream. Not thread-safe.
#ifndef CORE_ENVIRONMENT_NUMPY_RANDOM_H_
#define CORE_ENVIRONMENT_NUMPY_RANDOM_H_

#include <cstdint>
#include <limits>

#include "absl/numeric/int128.h"

namespace spikeserve {

// A UniformRandomBitGenerator, so the standard distributions and std::shuffle accept it too (their
// draws are not NumPy's).
class NumpyRandom {
 public:
  using result_type = uint64_t;

  explicit NumpyRandom(uint64_t seed);

  static constexpr uint64_t min() { return 0; }
  static constexpr uint64_t max() { return std::numeric_limits<uint64_t>::max(); }

  // The next 64 raw bits: PCG64.random_raw().
  uint64_t operator()();

  // Uniform on [low, high), with 53 random bits: Generator.uniform(low, high).
  double Uniform(double low, double high);

 private:
  void Advance();

  absl::uint128 state_ = 0;
  absl::uint128 increment_;  // odd
};

}  // namespace spikeserve

#endif  // CORE_ENVIRONMENT_NUMPY_RANDOM_H_
