// Generates random numbers from keys instead of a mutable state. A draw is a pure function of its
// key, so it does not depend on the number of earlier draws, on threads, or on whether a token is
// computed again:
//
//   const float draw = UniformFloat(RandomBits({seed, step, neuron}));
//
// All functions are pure and thread-safe.
#pragma once

#include <cstdint>
#include <initializer_list>

namespace spikeserve {

// Scrambles 64 bits with the finaliser of SplitMix64 (Steele, Lea & Flood, "Fast splittable
// pseudorandom number generators", OOPSLA 2014).
constexpr uint64_t MixBits(uint64_t x) {
  x += 0x9e3779b97f4a7c15ull;
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9ull;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebull;
  return x ^ (x >> 31);
}

// Returns 64 random bits for a key of any length. The order of the key's parts matters.
constexpr uint64_t RandomBits(std::initializer_list<uint64_t> key) {
  uint64_t state = 0;
  for (const uint64_t part : key) state = MixBits(state ^ MixBits(part));
  return state;
}

// Maps random bits to a float32 that is uniform in [0, 1). Uses 24 bits, so the result is exact.
constexpr float UniformFloat(uint64_t bits) { return static_cast<float>(bits >> 40) * 0x1p-24f; }

// Maps random bits to a double that is uniform in [0, 1). Uses 53 bits, so the result is exact.
constexpr double UniformDouble(uint64_t bits) { return static_cast<double>(bits >> 11) * 0x1p-53; }

}  // namespace spikeserve
