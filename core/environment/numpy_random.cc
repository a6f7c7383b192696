#include "core/environment/numpy_random.h"

#include <array>
#include <bit>

namespace spikeserve {
namespace {

// Constants of SeedSequence, with their names in numpy/random/bit_generator.pyx.
constexpr uint32_t kInitA = 0x43b0d7e5;
constexpr uint32_t kMultA = 0x931e8875;
constexpr uint32_t kInitB = 0x8b51f9dd;
constexpr uint32_t kMultB = 0x58f38ded;
constexpr uint32_t kMixMultL = 0xca01f9dd;
constexpr uint32_t kMixMultR = 0x4973f715;
constexpr int kXShift = 16;
constexpr int kPoolSize = 4;

using Pool = std::array<uint32_t, kPoolSize>;

// Hashes a word. Changes `constant`, so that equal words hash differently.
uint32_t HashMix(uint32_t value, uint32_t multiplier, uint32_t& constant) {
  value ^= constant;
  constant *= multiplier;
  value *= constant;
  return value ^ (value >> kXShift);
}

uint32_t Mix(uint32_t x, uint32_t y) {
  const uint32_t result = kMixMultL * x - kMixMultR * y;
  return result ^ (result >> kXShift);
}

// Returns SeedSequence(seed).pool.
Pool MixEntropy(uint64_t seed) {
  // A 64-bit seed has at most two words. SeedSequence fills the rest of the pool by hashing zeros.
  const Pool entropy = {static_cast<uint32_t>(seed), static_cast<uint32_t>(seed >> 32), 0, 0};
  uint32_t constant = kInitA;
  Pool pool;
  for (int i = 0; i < kPoolSize; ++i) pool[i] = HashMix(entropy[i], kMultA, constant);
  for (int source = 0; source < kPoolSize; ++source) {
    for (int target = 0; target < kPoolSize; ++target) {
      if (source == target) continue;
      pool[target] = Mix(pool[target], HashMix(pool[source], kMultA, constant));
    }
  }
  return pool;
}

// Returns SeedSequence(seed).generate_state(4, numpy.uint64).
std::array<uint64_t, 4> GenerateState(const Pool& pool) {
  std::array<uint64_t, 4> state;
  uint32_t constant = kInitB;
  for (int i = 0; i < 4; ++i) {
    const uint64_t low = HashMix(pool[(2 * i) % kPoolSize], kMultB, constant);
    const uint64_t high = HashMix(pool[(2 * i + 1) % kPoolSize], kMultB, constant);
    state[i] = high << 32 | low;
  }
  return state;
}

// Multiplier of PCG's default 128-bit generator.
constexpr absl::uint128 kMultiplier = absl::MakeUint128(0x2360ed051fc65da4, 0x4385df649fccf645);

}  // namespace

NumpyRandom::NumpyRandom(uint64_t seed) {
  const std::array<uint64_t, 4> words = GenerateState(MixEntropy(seed));
  increment_ = absl::MakeUint128(words[2], words[3]) << 1 | 1;
  Advance();
  state_ += absl::MakeUint128(words[0], words[1]);
  Advance();
}

void NumpyRandom::Advance() { state_ = state_ * kMultiplier + increment_; }

uint64_t NumpyRandom::operator()() {
  Advance();
  const uint64_t high = absl::Uint128High64(state_);
  return std::rotr(high ^ absl::Uint128Low64(state_), static_cast<int>(high >> 58));
}

double NumpyRandom::Uniform(double low, double high) {
  const double unit = static_cast<double>((*this)() >> 11) * 0x1p-53;
  return low + (high - low) * unit;
}

}  // namespace spikeserve
