// Softmax weights of keys whose scores have biases by distance: kernels of attention. Compiled once
// per SIMD target; only attention_kernels.cc may include it.
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "core/engine/spiking/kernels/attention_kernels.h"
#include "core/engine/spiking/kernels/overlap-inl.h"
#include "core/engine/spiking/kernels/simd/exp-inl.h"
#include "core/engine/spiking/kernels/simd/ordered_sum-inl.h"
#include "core/engine/spiking/kernels/simd/vectors-inl.h"
#include "hwy/highway.h"

// Highway's include guard, which admits this file once per target.
#if defined(CORE_ENGINE_SPIKING_KERNELS_BIASED_WEIGHTS_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef CORE_ENGINE_SPIKING_KERNELS_BIASED_WEIGHTS_INL_H_
#undef CORE_ENGINE_SPIKING_KERNELS_BIASED_WEIGHTS_INL_H_
#else
#define CORE_ENGINE_SPIKING_KERNELS_BIASED_WEIGHTS_INL_H_
#endif

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels::HWY_NAMESPACE {
namespace {

// The weights of one window's keys. Its methods are not inlined, because attention without biases,
// which shares their loop, would be slower. All sums run from the oldest to the newest token, that
// of the weights as in core/math/layer_norm.h.
class BiasedWeights {
 public:
  BiasedWeights(const AttentionWindow& window, const HeadScores& scores, Scratch* scratch)
      : window_(window), scores_(scores), scratch_(*scratch) {
    if (scores.biases == nullptr) return;
    // One row for each head without overlaps, which is the same at every tick, and one with them.
    scratch->weights.resize(static_cast<size_t>(window.heads + 1) * 2 * window.slots);
    scratch->totals.assign(window.heads + 1, 0.0f);
  }

  // Weighs the keys of a head. `overlaps` [S] is null if all are 0.
  HWY_NOINLINE void Weigh(int head, const uint32_t* overlaps) {
    row_ = overlaps == nullptr ? head : window_.heads;
    if (overlaps == nullptr && total() != 0.0f) return;
    SetScores(head, overlaps);
    scratch_.totals[row_] = Sum();
  }

  // Returns the sum of the weights of the valid slots.
  float total() const { return scratch_.totals[row_]; }

  // Sets sums[0, 32 W) to the sums of the weights of the valid slots with each value bit. `index`
  // is the number of the tick and head.
  HWY_NOINLINE void SumValues(int index, float* sums) const {
    const F32 d;
    const int blocks = window_.slots / kWordSlots;
    const int lanes = kWordSlots * window_.words;
    const uint32_t* const plane = window_.plane(window_.values[index]);
    const uint32_t* const occupied = window_.occupied + static_cast<size_t>(index) * blocks;
    const float* const weights = this->weights();
    const int first = window_.first / kWordSlots;  // the block of the oldest token
    // The slots of this block before the oldest token belong to the newest ones.
    const uint32_t newest = (1u << (window_.first % kWordSlots)) - 1;
    for (int lane = 0; lane < lanes; lane += kWordSlots) {
      hn::Vec<F32> sum[kVectorsPerWord];
      for (auto& each : sum) each = hn::Zero(d);
      for (int i = 0; i <= blocks; ++i) {
        const int block = first + i < blocks ? first + i : first + i - blocks;
        uint32_t slots = window_.valid[block] & occupied[block];
        if (i == 0) slots &= ~newest;
        if (i == blocks) slots &= newest;
        const uint32_t* const values = plane + static_cast<size_t>(block) * lanes + lane;
        for (; slots != 0; slots &= slots - 1) {
          const int bit = __builtin_ctz(slots);
          const auto own = hn::Set(U32(), 1u << bit);
          const auto weight = hn::Set(d, weights[block * kWordSlots + bit]);
          for (int v = 0; v < kVectorsPerWord; ++v) {
            const auto bits = hn::LoadU(U32(), values + v * kVector);
            const auto has_value = hn::RebindMask(d, hn::TestBit(bits, own));
            sum[v] = hn::Add(sum[v], hn::IfThenElseZero(has_value, weight));
          }
        }
      }
      for (int v = 0; v < kVectorsPerWord; ++v) hn::StoreU(sum[v], d, sums + lane + v * kVector);
    }
  }

 private:
  // Returns the weights of the slots, twice, so that the tokens of the ring are consecutive: [2 S].
  float* weights() const {
    return scratch_.weights.data() + static_cast<size_t>(row_) * 2 * window_.slots;
  }

  // Sets the weights of the slots to exp(score - best score).
  void SetScores(int head, const uint32_t* overlaps) {
    const F32 d;
    float* const weights = this->weights();
    const float* const biases = scores_.biases + 2 * static_cast<size_t>(head) * window_.slots +
                                window_.slots - 1 - window_.last;
    const auto scale = hn::Set(d, scores_.scale[head]);
    const auto worst = hn::Set(d, -std::numeric_limits<float>::infinity());
    auto highest = worst;
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      auto score = hn::LoadU(d, biases + slot);
      if (overlaps != nullptr) {
        const auto overlap =
            hn::ConvertTo(d, hn::BitCast(I32(), hn::LoadU(U32(), overlaps + slot)));
        score = hn::Add(hn::Mul(scale, overlap), score);
      }
      hn::StoreU(score, d, weights + slot);
      const auto valid = MaskFromBits(d, window_.valid[slot / kWordSlots] >> (slot % kWordSlots));
      highest = hn::Max(highest, hn::IfThenElse(valid, score, worst));
    }
    const auto best = hn::Set(d, hn::GetLane(hn::MaxOfLanes(d, highest)));
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      const auto weight = Exp(hn::Sub(hn::LoadU(d, weights + slot), best));
      hn::StoreU(weight, d, weights + slot);
      hn::StoreU(weight, d, weights + window_.slots + slot);
    }
  }

  float Sum() const {
    const F32 d;
    const float* const oldest = weights() + window_.first;
    const int last = window_.last + (window_.last < window_.first ? window_.slots : 0);
    const int tokens = last - window_.first + 1;
    return OrderedSum(tokens, [&](int i) HWY_ATTR {
      const auto exists = hn::FirstN(d, static_cast<size_t>(std::max(0, tokens - i)));
      return hn::IfThenElseZero(exists, hn::LoadU(d, oldest + i));
    });
  }

  const AttentionWindow& window_;
  const HeadScores& scores_;
  Scratch& scratch_;
  int row_ = 0;
};

}  // namespace
}  // namespace spikeserve::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif  // toggle
