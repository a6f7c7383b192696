// Generates the numbers of NumPy's default random generator, numpy.random.default_rng(seed), bit
// for bit.
//
// SeedSequence expands the seed (M. E. O'Neill's seed_seq_fe128: "Developing a seed_seq
// Alternative", 2015; NumPy: numpy/random/bit_generator.pyx). PCG64, the 128-bit linear
// congruential generator with XSL-RR output, generates the bits (M. E. O'Neill, "PCG: A Family of
// Simple Fast Space-Efficient Statistically Good Algorithms for Random Number Generation",
// HMC-CS-2014-0905; NumPy: numpy/random/src/pcg64). Uniform is Generator.uniform. NumPy's
// compatibility policy (NEP 19) guarantees that the streams of SeedSequence and PCG64 never change.
//
// A copy of a generator continues the stream independently. Not thread-safe.
#pragma once

#include <cstdint>
#include <limits>

#include "absl/numeric/int128.h"

namespace spikeserve {

// Satisfies UniformRandomBitGenerator, so the standard distributions and std::shuffle accept it,
// but their draws differ from NumPy's.
class NumpyRandom {
 public:
  using result_type = uint64_t;

  explicit NumpyRandom(uint64_t seed);

  static constexpr uint64_t min() { return 0; }
  static constexpr uint64_t max() { return std::numeric_limits<uint64_t>::max(); }

  // Returns the next 64 random bits (PCG64.random_raw()).
  uint64_t operator()();

  // Returns a number that is uniform in [low, high), with 53 random bits
  // (Generator.uniform(low, high)).
  double Uniform(double low, double high);

 private:
  void Advance();

  absl::uint128 state_ = 0;
  absl::uint128 increment_;  // odd
};

}  // namespace spikeserve
