// Compares the weights of integer attention with biases by distance with plain loops, on every SIMD
// target of this processor, while tokens go round the ring.

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <vector>

#include "core/engine/spiking/integer_cache.h"
#include "core/engine/spiking/kernels/integer_attention_kernels.h"
#include "core/engine/spiking/packed/ring_biases.h"
#include "core/engine/token.h"
#include "core/math/counter_random.h"
#include "core/math/fixed_point.h"
#include "core/model/fixed_point_weights.h"
#include "tests/support/simd_targets.h"

namespace spikeserve {
namespace {

// Returns a number from -range to range.
int Draw(int range, uint64_t what, uint64_t a, uint64_t b) {
  return static_cast<int>(RandomBits({what, a, b}) % (2 * static_cast<uint64_t>(range) + 1)) -
         range;
}

// The distances and scales are as large as a file may have them.
TEST(BiasedShiftmaxTest, WeightsEqualTheEquation) {
  OnEverySimdTarget([] {
    for (const int context : {1, 5, 20, 21}) {
      const int ring = kTokensPerTimestep * context;
      for (uint64_t round = 0; round < 200; ++round) {
        IntegerBand band({.context = context});
        const int64_t timesteps = 1 + static_cast<int64_t>(RandomBits({1, round}) % (3 * context));
        for (int64_t t = 0; t < timesteps; ++t) {
          while (band.Expire(t - context + 1) >= 0) {
          }
          for (int n = 0; n < kTokensPerTimestep; ++n) band.Add(t);
        }
        const int range = round % 2 == 0 ? 700 : kLargestRelative;
        Int16Tensor relative = Int16Tensor::Zeros({1, ring});
        for (int i = 0; i < ring; ++i) {
          relative.values[i] = static_cast<int16_t>(Draw(range, 2, round, i));
        }
        std::vector<int16_t> biases = RingBiases(relative, ring);
        biases.resize(biases.size() + kernels::kSlotBlock);
        const int slots = band.used_slots(), last = band.last();
        std::vector<int32_t> overlaps(slots);
        for (int s = 0; s < slots; ++s) {
          const int most = round % 3 == 0 ? 1 << 19 : 60;
          overlaps[s] = band.held()[s] & std::abs(Draw(most, 3, round, s));
        }
        for (const int scale : {0, 1, 40, -40, 32767, -32767}) {
          std::vector<int64_t> scores(slots);
          int64_t best = -(int64_t{1} << 40);
          for (int s = 0; s < slots; ++s) {
            if (band.held()[s] == 0) continue;
            const int distance = (last + ring - s) % ring;
            scores[s] = int64_t{scale} * overlaps[s] + relative.values[distance];
            best = std::max(best, scores[s]);
          }
          std::vector<int16_t> expected(slots);
          int32_t sum = 0;
          for (int s = 0; s < slots; ++s) {
            if (band.held()[s] == 0) continue;
            const int64_t octaves = RoundShift(best - scores[s], kScaleFraction);
            expected[s] = static_cast<int16_t>(octaves > 8 ? 0 : 256 >> octaves);
            sum += expected[s];
          }
          std::vector<int16_t> weights(slots, -7);
          EXPECT_EQ(kernels::BiasedShiftmax(scale, overlaps.data(), biases.data() + ring - 1 - last,
                                            band.held(), slots, weights.data()),
                    sum);
          EXPECT_EQ(weights, expected);
        }
      }
    }
  });
}

}  // namespace
}  // namespace spikeserve
