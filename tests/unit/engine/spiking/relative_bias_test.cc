// Compares attention with biases by distance with plain loops, on every SIMD target of this
// processor, while tokens go round the ring.

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <deque>
#include <vector>

#include "core/engine/spiking/attention_cache.h"
#include "core/engine/spiking/integer_cache.h"
#include "core/engine/spiking/kernels/attention_kernels.h"
#include "core/engine/spiking/kernels/integer_attention_kernels.h"
#include "core/engine/spiking/packed/ring_biases.h"
#include "core/engine/token.h"
#include "core/math/counter_random.h"
#include "core/math/exp.h"
#include "core/math/fixed_point.h"
#include "core/math/layer_norm.h"
#include "core/model/fixed_point_weights.h"
#include "tests/support/simd_targets.h"

namespace spikeserve {
namespace {

TEST(RingBiasesTest, TheTokensOfARingHaveThoseOfTheirDistances) {
  const Int16Tensor relative = {{2, 3}, {10, 11, 12, 20, 21, 22}};
  constexpr int kSlots = 4;
  const std::vector<int16_t> biases = RingBiases(relative, kSlots);
  ASSERT_EQ(biases.size(), 16u);
  for (int last = 0; last < kSlots; ++last) {
    for (int head = 0; head < 2; ++head) {
      for (int distance = 0; distance < 3; ++distance) {
        const int slot = (last + kSlots - distance) % kSlots;
        EXPECT_EQ(biases[2 * kSlots * head + kSlots - 1 - last + slot],
                  relative.at(head, distance));
      }
    }
  }
}

// Spikes of one token, [T][H][W].
using Bits = std::vector<uint32_t>;

// Random spikes. Each tick and head is silent in one of three tokens.
Bits DrawBits(const ModelConfig& config, uint64_t stream, uint64_t token) {
  const int words = (config.head_size() + 31) / 32;
  Bits bits(static_cast<size_t>(config.ticks) * config.heads * words);
  for (size_t i = 0; i < bits.size(); ++i) {
    const int left = std::min(32, config.head_size() - static_cast<int>(i) % words * 32);
    const auto mask = static_cast<uint32_t>((uint64_t{1} << left) - 1);
    const bool silent = RandomBits({stream, token, i / words, 7}) % 3 == 0;
    bits[i] = silent ? 0u : static_cast<uint32_t>(RandomBits({stream, token, i})) & mask;
  }
  return bits;
}

struct StoredToken {
  Bits keys;
  Bits values;
};

class RelativeBiasTest : public testing::TestWithParam<ModelConfig> {
 protected:
  // Returns y_h(t) by the equation, and adds the overlaps to `products`. The last token asks.
  std::vector<float> Attended(const Bits& query, int tick, int head, uint64_t* products) const {
    const int size = config_.head_size();
    const size_t words = (static_cast<size_t>(size) + 31) / 32;
    const size_t at = (static_cast<size_t>(tick) * config_.heads + head) * words;
    std::vector<float> scores;
    for (size_t n = 0; n < band_.size(); ++n) {
      int overlap = 0;
      for (size_t w = at; w < at + words; ++w) {
        overlap += __builtin_popcount(query[w] & band_[n].keys[w]);
      }
      *products += static_cast<uint64_t>(overlap);
      const float bias = relative_.at(head, static_cast<int>(band_.size() - 1 - n));
      scores.push_back(scale_[head] * static_cast<float>(overlap) + bias);
    }
    const float best = *std::max_element(scores.begin(), scores.end());
    std::vector<float> y(size, 0.0f);
    for (size_t n = 0; n < band_.size(); ++n) {
      const float weight = scores[n] = Exp(scores[n] - best);
      for (int k = 0; k < size; ++k) {
        if (band_[n].values[at + k / 32] >> (k % 32) & 1u) y[k] += weight;
      }
    }
    const float inverse = 1.0f / OrderedSum(scores.data(), scores.size());
    for (float& value : y) value *= inverse;
    return y;
  }

  bool HasValues(int tick) const {
    const size_t words = band_[0].values.size() / config_.ticks;
    return std::any_of(band_.begin(), band_.end(), [&](const StoredToken& token) {
      const auto first = token.values.begin() + static_cast<std::ptrdiff_t>(tick * words);
      return std::any_of(first, first + static_cast<std::ptrdiff_t>(words),
                         [](uint32_t word) { return word != 0; });
    });
  }

  // Compares the output for a query of the newest token.
  void ExpectEqual(const AttentionBand& band, const AttentionCache& cache,
                   const Bits& query) const {
    const std::vector<float> ring = RingBiases(relative_, band.slots());
    std::vector<float> y(static_cast<size_t>(config_.ticks) * config_.hidden_size);
    const kernels::HeadScores scores = {
        .scale = scale_.data(), .weight = nullptr, .biases = ring.data()};
    const kernels::Attended actual =
        kernels::Attend(cache.Window(band), query.data(), scores, y.data());
    std::vector<float> expected;
    uint64_t products = 0;
    for (int tick = 0; tick < config_.ticks; ++tick) {
      std::vector<float> of_tick;
      for (int head = 0; head < config_.heads; ++head) {
        const std::vector<float> part = Attended(query, tick, head, &products);
        of_tick.insert(of_tick.end(), part.begin(), part.end());
      }
      if (HasValues(tick)) expected.insert(expected.end(), of_tick.begin(), of_tick.end());
    }
    y.resize(static_cast<size_t>(actual.ticks) * config_.hidden_size);
    EXPECT_EQ(y, expected);
    EXPECT_EQ(actual.products, products);
  }

  void SetUp() override {
    relative_ = Tensor::Zeros({config_.heads, kTokensPerTimestep * config_.context});
    for (size_t i = 0; i < relative_.values.size(); ++i) {
      relative_.values[i] = 6.0f * UniformFloat(RandomBits({3, i})) - 3.0f;
    }
    for (int head = 0; head < config_.heads; ++head) scale_.push_back(head % 2 ? -0.3f : 0.4f);
  }

  ModelConfig config_ = GetParam();
  Tensor relative_;
  std::vector<float> scale_;
  std::deque<StoredToken> band_;  // from the oldest to the newest
};

TEST_P(RelativeBiasTest, OutputsEqualTheEquation) {
  OnEverySimdTarget([&] {
    AttentionBand band(config_);
    AttentionCache cache(config_, band.slots());
    band_.clear();
    for (int64_t timestep = 0; timestep < 3 * config_.context; ++timestep) {
      band.Advance(timestep);
      if (timestep >= config_.context) band_.erase(band_.begin(), band_.begin() + 3);
      for (const TokenKind kind : {TokenKind::kReturn, TokenKind::kState, TokenKind::kAction}) {
        const auto token = static_cast<uint64_t>(3 * timestep) + static_cast<uint64_t>(kind);
        band_.push_back({DrawBits(config_, 1, token), DrawBits(config_, 2, token)});
        const int slot = band.Slot(timestep, kind);
        cache.Store(band_.back().keys.data(), band_.back().values.data(), 0, slot);
        band.Add(slot);
      }
      const bool is_checked = config_.context < 100 || timestep % 97 == 0;
      if (!is_checked) continue;
      ExpectEqual(band, cache, DrawBits(config_, 4, static_cast<uint64_t>(timestep)));
    }
  });
}

INSTANTIATE_TEST_SUITE_P(
    Sizes, RelativeBiasTest,
    testing::Values(ModelConfig{.hidden_size = 64, .heads = 2, .ticks = 3, .context = 20},
                    ModelConfig{.hidden_size = 35, .heads = 5, .ticks = 4, .context = 7},
                    ModelConfig{.hidden_size = 140, .heads = 2, .ticks = 2, .context = 30},
                    ModelConfig{.hidden_size = 16, .heads = 1, .ticks = 1, .context = 1},
                    ModelConfig{.hidden_size = 48, .heads = 2, .ticks = 2, .context = 345}));

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
