// Compares the caches of attention in integer arithmetic, and the kernels that read them, with
// plain loops, on every SIMD target of this processor.

#include "core/engine/spiking/integer_cache.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdint>
#include <map>
#include <utility>
#include <vector>

#include "core/engine/spiking/kernels/integer_attention_kernels.h"
#include "core/engine/spiking/packed/packed_linear.h"
#include "core/math/counter_random.h"
#include "core/model/config.h"
#include "tests/support/simd_targets.h"

namespace spikeserve {
namespace {

// Returns a number from `low` to `high`.
int Draw(int low, int high, uint64_t what, int token, int index) {
  const auto count = static_cast<uint64_t>(high - low + 1);
  const uint64_t bits =
      RandomBits({what, static_cast<uint64_t>(token), static_cast<uint64_t>(index)});
  return low + static_cast<int>(bits % count);
}

// A ring of tokens beside plain copies of their keys and values.
class SlotsTest : public testing::TestWithParam<ModelConfig> {
 protected:
  struct Token {
    std::vector<uint32_t> keys;   // [T][H][W]
    std::vector<int16_t> counts;  // [planes][pad(d)], and kLanes more
  };

  size_t width() const { return static_cast<size_t>(PadToLanes(config_.hidden_size)); }
  int words() const { return (config_.head_size() + 31) / 32; }

  std::vector<uint32_t> DrawBits(uint64_t stream, int token) const {
    std::vector<uint32_t> bits(static_cast<size_t>(config_.ticks) * config_.heads * words());
    for (size_t i = 0; i < bits.size(); ++i) {
      const int left = config_.head_size() - static_cast<int>(i) % words() * 32;
      const auto all = static_cast<uint32_t>(left < 32 ? (1 << left) - 1 : -1);
      const auto drawn =
          static_cast<uint32_t>(RandomBits({stream, static_cast<uint64_t>(token), i}));
      bits[i] = (token % 4 == 0 ? all : drawn) & all;  // all: for the largest sums
    }
    return bits;
  }

  // Adds a timestep of three tokens, and removes those that leave the context.
  void Advance(int64_t timestep) {
    const int64_t first = timestep - config_.context + 1;
    for (int slot = band_.Expire(first); slot >= 0; slot = band_.Expire(first)) {
      cache_.Remove(slot);
      tokens_.erase(slot);
    }
    for (int n = 0; n < 3; ++n) {
      const int slot = band_.Add(timestep);
      const int number = static_cast<int>(3 * timestep) + n;
      const int planes = config_.attention_planes(), most = config_.plane_ticks();
      Token token{DrawBits(11, number), std::vector<int16_t>(planes * width() + kLanes)};
      for (int plane = 0; plane < planes; ++plane) {
        for (int k = 0; k < config_.hidden_size; ++k) {
          const int count = std::max(0, Draw(-most, most, 12, number, 4096 * plane + k));
          token.counts[plane * width() + k] = static_cast<int16_t>(count);
        }
      }
      cache_.Store(slot, token.keys.data(), token.counts.data());
      tokens_[slot] = std::move(token);
    }
  }

  ModelConfig config_ = GetParam();
  IntegerBand band_{config_};
  IntegerCache cache_{config_};
  std::map<int, Token> tokens_;  // by slot
};

TEST_P(SlotsTest, OverlapsAndWeighedValuesEqualTheEquation) {
  OnEverySimdTarget([&] {
    band_ = IntegerBand(config_);
    cache_ = IntegerCache(config_);
    tokens_.clear();
    const int size = config_.head_size();
    for (int64_t timestep = 0; timestep < 2 * config_.context + 1; ++timestep) {
      Advance(timestep);
      const int plane = static_cast<int>(timestep) % config_.attention_planes();
      const size_t values = plane * width();
      for (int k = 0; k < config_.hidden_size; ++k) {
        int32_t sum = 0;
        for (const auto& [slot, token] : tokens_) sum += token.counts[values + k];
        ASSERT_EQ(cache_.sums(plane)[k], sum);
      }
      const std::vector<uint32_t> bits = DrawBits(13, static_cast<int>(timestep));
      for (int head = 0; head < config_.heads; ++head) {
        std::vector<kernels::QueryWord> query;
        std::vector<int32_t> overlaps(band_.used_slots());
        std::vector<int16_t> weights(band_.used_slots());
        std::vector<int32_t> sums(size);
        uint64_t overlap = 0;
        uint64_t nonzero = 0;
        for (int tick = 0; tick < config_.ticks; tick += 2) {
          for (int word = 0; word < words(); ++word) {
            const size_t i = (static_cast<size_t>(tick) * config_.heads + head) * words() + word;
            query.push_back({tick * words() + word, bits[i]});
            for (const auto& [slot, token] : tokens_) {
              overlaps[slot] += __builtin_popcount(bits[i] & token.keys[i]);
            }
          }
        }
        for (const auto& [slot, token] : tokens_) {
          overlap += static_cast<uint64_t>(overlaps[slot]);
          weights[slot] = static_cast<int16_t>(std::max(0, Draw(-9000, 32767, 14, slot, head)));
          if (slot / kernels::kSlotBlock == 1) weights[slot] = 0;
          for (int k = 0; k < size; ++k) {
            const int16_t count = token.counts[values + head * size + k];
            sums[k] += weights[slot] * count;
            nonzero += weights[slot] != 0 && count != 0;
          }
        }
        std::vector<int32_t> computed(band_.used_slots(), -7);
        const kernels::HeadSlots own = cache_.head(head, plane);
        EXPECT_EQ(kernels::Overlaps(query, own, band_.held(), band_.used_slots(), computed.data()),
                  overlap);
        EXPECT_EQ(computed, overlaps);
        computed.assign(PadToLanes(size), -7);
        EXPECT_EQ(kernels::WeighValues(weights.data(), own, band_.used_slots(), computed.data()),
                  nonzero);
        computed.resize(size);
        EXPECT_EQ(computed, sums);
      }
    }
  });
}

INSTANTIATE_TEST_SUITE_P(
    Sizes, SlotsTest,
    testing::Values(ModelConfig{.hidden_size = 128, .heads = 4, .ticks = 10, .context = 20},
                    ModelConfig{.hidden_size = 128,
                                .heads = 4,
                                .ticks = 10,
                                .context = 20,
                                .attention = AttentionTicks::kAllTicks},
                    ModelConfig{.hidden_size = 64, .heads = 8, .ticks = 1, .context = 7},
                    ModelConfig{.hidden_size = 33, .heads = 3, .ticks = 3, .context = 5},
                    ModelConfig{.hidden_size = 150, .heads = 2, .ticks = 70, .context = 6},
                    ModelConfig{.hidden_size = 5, .heads = 1, .ticks = 255, .context = 1},
                    ModelConfig{.hidden_size = 5,
                                .heads = 1,
                                .ticks = 255,
                                .context = 1,
                                .attention = AttentionTicks::kAllTicks}));

}  // namespace
}  // namespace spikeserve
