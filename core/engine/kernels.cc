#include "core/engine/kernels.h"

#include <algorithm>
#include <cmath>
#include <type_traits>

#include "core/math/layer_norm.h"

#define HWY_WANT_AVX3_DL 1
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/engine/kernels.cc"
#include "hwy/foreach_target.h"  // compiles what follows once per target
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace spikeserve::kernels {
namespace HWY_NAMESPACE {
namespace {

namespace hn = hwy::HWY_NAMESPACE;

using F32 = hn::CappedTag<float, 16>;
using I32 = hn::RebindToSigned<F32>;
using U32 = hn::RebindToUnsigned<F32>;
using VecF = hn::Vec<F32>;

constexpr int kVector = static_cast<int>(hn::MaxLanes(F32()));
constexpr int kVectorsPerWord = kLanes / kVector;

void CoderPeriodsImpl(const Lif& lif, const float* x, const float* gain, const float* bias,
                      int size, int ticks, int32_t* periods) {
  const F32 d;
  const I32 di;
  const auto decay = hn::Set(d, lif.decay);
  const auto threshold = hn::Set(d, lif.threshold);
  int j = 0;
  for (; j + kVector <= size; j += kVector) {
    const auto current =
        hn::Add(hn::Mul(hn::LoadU(d, x + j), hn::LoadU(d, gain + j)), hn::LoadU(d, bias + j));
    auto membrane = hn::Zero(d);
    auto period = hn::Zero(d);
    // Past its first spike a membrane means nothing any more, so it need not be reset.
    for (int tick = 1; tick <= ticks; ++tick) {
      membrane = hn::Add(hn::Mul(decay, membrane), current);
      const auto first = hn::And(hn::Ge(membrane, threshold), hn::Eq(period, hn::Zero(d)));
      period = hn::IfThenElse(first, hn::Set(d, static_cast<float>(tick)), period);
    }
    hn::StoreU(hn::ConvertTo(di, period), di, periods + j);
  }
  for (; j < size; ++j) periods[j] = lif.Period(x[j] * gain[j] + bias[j], ticks);
}

// Calls block(lane, count<V>) over [0, width): blocks of eight vectors, so that additions overlap,
// then of kLanes.
template <class Block>
HWY_INLINE void ForEachBlock(int width, Block block) {
  int lane = 0;
  for (; lane + 8 * kVector <= width; lane += 8 * kVector)
    block(lane, std::integral_constant<int, 8>());
  for (; lane < width; lane += kLanes) block(lane, std::integral_constant<int, kVectorsPerWord>());
}

void SumRowsImpl(const PackedLinear& linear, const int32_t* members, int count, int width,
                 float* sum) {
  const F32 d;
  ForEachBlock(width, [&](int lane, auto vectors) HWY_ATTR {
    VecF total[vectors];
    for (int v = 0; v < vectors; ++v) total[v] = hn::Zero(d);
    for (int m = 0; m < count; ++m) {
      const float* row = linear.row(members[m]) + lane;
      for (int v = 0; v < vectors; ++v)
        total[v] = hn::Add(total[v], hn::LoadU(d, row + v * kVector));
    }
    for (int v = 0; v < vectors; ++v) hn::StoreU(total[v], d, sum + lane + v * kVector);
  });
}

// Runs the kLanes neurons from `lane` on; calls on_spike(tick, v, mask) for every vector v of them.
template <class OnSpike>
HWY_INLINE void RunLif(const Lif& lif, const float* bias, const Drive& drive, int lane,
                       OnSpike on_spike) {
  const F32 d;
  const auto decay = hn::Set(d, lif.decay);
  const auto threshold = hn::Set(d, lif.threshold);
  VecF membrane[kVectorsPerWord];
  for (int v = 0; v < kVectorsPerWord; ++v) membrane[v] = hn::Zero(d);
  for (int tick = 0; tick < drive.ticks; ++tick) {
    VecF current[kVectorsPerWord];
    for (int v = 0; v < kVectorsPerWord; ++v) current[v] = hn::LoadU(d, bias + lane + v * kVector);
    for (int k = drive.offsets[tick]; k < drive.offsets[tick + 1]; ++k) {
      const float* term = drive.terms[k] + lane;
      for (int v = 0; v < kVectorsPerWord; ++v)
        current[v] = hn::Add(current[v], hn::LoadU(d, term + v * kVector));
    }
    for (int v = 0; v < kVectorsPerWord; ++v) {
      membrane[v] = hn::Add(hn::Mul(decay, membrane[v]), current[v]);
      const auto spike = hn::Ge(membrane[v], threshold);
      membrane[v] = hn::IfThenZeroElse(spike, membrane[v]);
      on_spike(tick, v, spike);
    }
  }
}

void LifBitsImpl(const Lif& lif, const float* bias, const Drive& drive, int width, uint32_t* bits) {
  const F32 d;
  const int words = width / kLanes;
  std::fill_n(bits, static_cast<size_t>(drive.ticks) * words, 0u);
  for (int word = 0; word < words; ++word) {
    RunLif(lif, bias, drive, word * kLanes, [&](int tick, int v, auto spike) HWY_ATTR {
      uint8_t packed[8] = {};
      hn::StoreMaskBits(d, spike, packed);
      const uint32_t mask = packed[0] | static_cast<uint32_t>(packed[1]) << 8;
      bits[static_cast<size_t>(tick) * words + word] |= mask << (v * kVector);
    });
  }
}

void LifCountsImpl(const Lif& lif, const float* bias, const Drive& drive, int width,
                   float* counts) {
  const F32 d;
  for (int lane = 0; lane < width; lane += kLanes) {
    VecF count[kVectorsPerWord];
    for (int v = 0; v < kVectorsPerWord; ++v) count[v] = hn::Zero(d);
    RunLif(lif, bias, drive, lane, [&](int, int v, auto spike) HWY_ATTR {
      count[v] = hn::Add(count[v], hn::IfThenElseZero(spike, hn::Set(d, 1.0f)));
    });
    for (int v = 0; v < kVectorsPerWord; ++v) hn::StoreU(count[v], d, counts + lane + v * kVector);
  }
}

uint64_t AffineImpl(const PackedLinear& linear, const float* input, float* output) {
  thread_local std::vector<int32_t> active;  // nonzero inputs, ascending
  active.clear();
  uint64_t products = 0;
  for (int j = 0; j < linear.inputs; ++j) {
    if (input[j] == 0.0f) continue;
    active.push_back(j);
    products += linear.nonzero[j];
  }
  const F32 d;
  ForEachBlock(linear.width, [&](int lane, auto vectors) HWY_ATTR {
    VecF total[vectors];
    for (int v = 0; v < vectors; ++v)
      total[v] = hn::LoadU(d, linear.bias.data() + lane + v * kVector);
    for (const int32_t j : active) {
      const auto x = hn::Set(d, input[j]);
      const float* row = linear.row(j) + lane;
      for (int v = 0; v < vectors; ++v)
        total[v] = hn::Add(total[v], hn::Mul(hn::LoadU(d, row + v * kVector), x));
    }
    for (int v = 0; v < vectors; ++v) hn::StoreU(total[v], d, output + lane + v * kVector);
  });
  return products;
}

// Nonzero weights that the nonzero inputs meet.
HWY_INLINE uint64_t CountProducts(const PackedLinear& linear, const float* input) {
  const F32 d;
  const U32 du;
  auto products = hn::Zero(du);
  int j = 0;
  for (; j + kVector <= linear.inputs; j += kVector) {
    const auto active = hn::RebindMask(du, hn::Ne(hn::LoadU(d, input + j), hn::Zero(d)));
    products =
        hn::Add(products, hn::IfThenElseZero(active, hn::LoadU(du, linear.nonzero.data() + j)));
  }
  uint64_t total = hn::GetLane(hn::SumOfLanes(du, products));
  for (; j < linear.inputs; ++j) total += input[j] != 0.0f ? linear.nonzero[j] : 0;
  return total;
}

// `ticks` (at most kTicks) rows at once, so that a weight is loaded once for all of them.
template <int kTicks>
HWY_INLINE void AffineBlock(const PackedLinear& linear, const float* input, int stride,
                            float* output) {
  const F32 d;
  for (int lane = 0; lane < linear.outputs; lane += kVector) {
    VecF total[kTicks];
    for (int t = 0; t < kTicks; ++t) total[t] = hn::LoadU(d, linear.bias.data() + lane);
    for (int j = 0; j < linear.inputs; ++j) {
      const auto weight = hn::LoadU(d, linear.row(j) + lane);
      for (int t = 0; t < kTicks; ++t) {
        total[t] = hn::Add(total[t],
                           hn::Mul(weight, hn::Set(d, input[static_cast<size_t>(t) * stride + j])));
      }
    }
    for (int t = 0; t < kTicks; ++t)
      hn::StoreU(total[t], d, output + static_cast<size_t>(t) * linear.width + lane);
  }
}

uint64_t AffineTicksImpl(const PackedLinear& linear, const float* input, int stride, int ticks,
                         float* output) {
  uint64_t products = 0;
  for (int t = 0; t < ticks; ++t)
    products += CountProducts(linear, input + static_cast<size_t>(t) * stride);
  int t = 0;
  const auto in = [&] { return input + static_cast<size_t>(t) * stride; };
  const auto out = [&] { return output + static_cast<size_t>(t) * linear.width; };
  for (; t + 8 <= ticks; t += 8) AffineBlock<8>(linear, in(), stride, out());
  for (; t + 2 <= ticks; t += 2) AffineBlock<2>(linear, in(), stride, out());
  for (; t < ticks; ++t) AffineBlock<1>(linear, in(), stride, out());
  return products;
}

// spikeserve::Exp of every lane, same bits.
HWY_INLINE VecF Exp(VecF x) {
  const F32 d;
  const I32 di;
  const auto round = hn::Set(d, 12582912.0f);
  x = hn::Min(hn::Max(x, hn::Set(d, -87.0f)), hn::Set(d, 88.0f));
  const auto n = hn::Sub(hn::Add(hn::Mul(x, hn::Set(d, 1.44269504088896341f)), round), round);
  x = hn::Sub(x, hn::Mul(n, hn::Set(d, 0.693359375f)));
  x = hn::Sub(x, hn::Mul(n, hn::Set(d, -2.12194440e-4f)));
  auto y = hn::Set(d, 1.9875691500e-4f);
  for (const float coefficient :
       {1.3981999507e-3f, 8.3334519073e-3f, 4.1665795894e-2f, 1.6666665459e-1f, 5.0000001201e-1f}) {
    y = hn::Add(hn::Mul(y, x), hn::Set(d, coefficient));
  }
  y = hn::Add(hn::Add(hn::Mul(y, hn::Mul(x, x)), x), hn::Set(d, 1.0f));
  const auto exponent = hn::ShiftLeft<23>(hn::Add(hn::ConvertTo(di, n), hn::Set(di, 127)));
  return hn::Mul(y, hn::BitCast(d, exponent));
}

void SoftmaxImpl(float* rows, int count, int stride, int size) {
  const F32 d;
  for (int r = 0; r < count; ++r) {
    float* row = rows + static_cast<size_t>(r) * stride;
    const float best = *std::max_element(row, row + size);
    for (int i = 0; i < size; i += kVector) {
      hn::StoreU(Exp(hn::Sub(hn::LoadU(d, row + i), hn::Set(d, best))), d, row + i);
    }
    float sum = 0.0f;
    for (int i = 0; i < size; ++i) sum += row[i];
    for (int i = 0; i < size; ++i) row[i] /= sum;
  }
}

void GateHeadsImpl(const HeadOutputs& heads, const float* gates, int stride, bool concat,
                   float* merged) {
  const F32 d;
  const int size = heads.head_size;
  const auto ticks = static_cast<float>(heads.ticks);
  const auto gate = [&](int t, int h) { return gates[static_cast<size_t>(t) * stride + h]; };
  for (int group = 0; group < (concat ? heads.heads : 1); ++group) {
    const int first = concat ? group : 0;
    const int last = concat ? group : heads.heads - 1;
    int k = 0;
    for (; k + kVector <= size; k += kVector) {
      auto total = hn::Zero(d);
      for (int t = 0; t < heads.ticks; ++t) {
        auto routed = hn::Zero(d);
        for (int h = first; h <= last; ++h) {
          routed =
              hn::Add(routed, hn::Mul(hn::Set(d, gate(t, h)), hn::LoadU(d, heads.at(t, h) + k)));
        }
        total = hn::Add(total, routed);
      }
      hn::StoreU(hn::Div(total, hn::Set(d, ticks)), d, merged + group * size + k);
    }
    for (; k < size; ++k) {
      float total = 0.0f;
      for (int t = 0; t < heads.ticks; ++t) {
        float routed = 0.0f;
        for (int h = first; h <= last; ++h) routed += gate(t, h) * heads.at(t, h)[k];
        total += routed;
      }
      merged[group * size + k] = total / ticks;
    }
  }
}

uint64_t CountBitsImpl(const uint32_t* words, int count) {
  const U32 du;
  auto total = hn::Zero(du);
  int i = 0;
  for (; i + kVector <= count; i += kVector)
    total = hn::Add(total, hn::PopulationCount(hn::LoadU(du, words + i)));
  uint64_t bits = hn::GetLane(hn::SumOfLanes(du, total));
  for (; i < count; ++i) bits += __builtin_popcount(words[i]);
  return bits;
}

// The sum of kSumLanes interleaved partial sums of term(i), folded as in core/math/layer_norm.h.
template <class Term>
HWY_INLINE float OrderedSum(int size, Term term) {
  const F32 d;
  constexpr int kParts = kSumLanes / kVector;
  VecF part[kParts];
  for (int p = 0; p < kParts; ++p) part[p] = hn::Zero(d);
  for (int i = 0; i < size; i += kSumLanes) {
    for (int p = 0; p < kParts; ++p) part[p] = hn::Add(part[p], term(i + p * kVector));
  }
  float partial[kSumLanes];
  for (int p = 0; p < kParts; ++p) hn::StoreU(part[p], d, partial + p * kVector);
  for (int half = kSumLanes / 2; half > 0; half /= 2) {
    for (int lane = 0; lane < half; ++lane) partial[lane] += partial[lane + half];
  }
  return partial[0];
}

void LayerNormImpl(const float* weight, const float* bias, float* x, int size) {
  if (size % kSumLanes != 0) return spikeserve::LayerNorm(weight, bias, x, size);
  const F32 d;
  const float mean = OrderedSum(size, [&](int i) HWY_ATTR { return hn::LoadU(d, x + i); }) /
                     static_cast<float>(size);
  const float sum = OrderedSum(size, [&](int i) HWY_ATTR {
    const auto centred = hn::Sub(hn::LoadU(d, x + i), hn::Set(d, mean));
    hn::StoreU(centred, d, x + i);
    return hn::Mul(centred, centred);
  });
  const float inverse = 1.0f / std::sqrt(sum / static_cast<float>(size) + kLayerNormEpsilon);
  for (int i = 0; i < size; i += kVector) {
    const auto scaled =
        hn::Mul(hn::Mul(hn::LoadU(d, x + i), hn::Set(d, inverse)), hn::LoadU(d, weight + i));
    hn::StoreU(hn::Add(scaled, hn::LoadU(d, bias + i)), d, x + i);
  }
}

// overlaps[slot] = popcount(q & k) of one tick and head; keys [W][S].
HWY_INLINE void Overlaps(const uint32_t* keys, const uint32_t* query, int words, int slots,
                         uint32_t* overlaps) {
  const U32 du;
  for (int slot = 0; slot < slots; slot += kVector) {
    auto total = hn::Zero(du);
    for (int w = 0; w < words; ++w) {
      const auto key = hn::LoadU(du, keys + static_cast<size_t>(w) * slots + slot);
      total = hn::Add(total, hn::PopulationCount(hn::And(key, hn::Set(du, query[w]))));
    }
    hn::StoreU(total, du, overlaps + slot);
  }
}

// The slots of one 32-slot block whose overlap is `overlap`, as bits.
HWY_INLINE uint32_t SlotsAt(const uint32_t* overlaps, uint32_t overlap) {
  const U32 du;
  uint32_t mask = 0;
  for (int v = 0; v < kVectorsPerWord; ++v) {
    uint8_t packed[8] = {};
    hn::StoreMaskBits(du, hn::Eq(hn::LoadU(du, overlaps + v * kVector), hn::Set(du, overlap)),
                      packed);
    mask |= (packed[0] | static_cast<uint32_t>(packed[1]) << 8) << (v * kVector);
  }
  return mask;
}

// y[lane] += weight * (how many of the slots in `members` [blocks] have value bit `lane`); values
// [blocks][lanes].
HWY_INLINE void AddGroup(const uint32_t* values, const uint32_t* members, int blocks, int lanes,
                         float weight, float* y) {
  const F32 d;
  const I32 di;
  const U32 du;
  for (int lane = 0; lane < lanes; lane += kVector) {
    auto count = hn::Zero(du);
    for (int b = 0; b < blocks; ++b) {
      const auto bits = hn::LoadU(du, values + static_cast<size_t>(b) * lanes + lane);
      count = hn::Add(count, hn::PopulationCount(hn::And(bits, hn::Set(du, members[b]))));
    }
    const auto share = hn::Mul(hn::Set(d, weight), hn::ConvertTo(d, hn::BitCast(di, count)));
    hn::StoreU(hn::Add(hn::LoadU(d, y + lane), share), d, y + lane);
  }
}

// One tick and head. `scratch` holds S overlaps, then S / 32 member words, then 32 W sums.
class HeadAttention {
 public:
  HeadAttention(const AttentionWindow& window, uint32_t* overlaps, uint32_t* members, float* sums)
      : window_(window),
        blocks_(window.slots / 32),
        overlaps_(overlaps),
        members_(members),
        sums_(sums) {}

  uint64_t Run(const uint32_t* keys, const uint32_t* values, const uint32_t* query,
               const float* weight, bool largest_is_best, float* y) {
    const int lanes = 32 * window_.words;
    std::fill_n(sums_, lanes, 0.0f);
    float total = 0.0f;
    uint64_t products = 0;
    const bool silent =
        std::all_of(query, query + window_.words, [](uint32_t word) { return word == 0; });
    if (silent) {
      total = static_cast<float>(CountMembers(window_.valid));
      AddGroup(values, window_.valid, blocks_, lanes, 1.0f, sums_);
    } else {
      Overlaps(keys, query, window_.words, window_.slots, overlaps_);
      const auto [lowest, highest] = Range();
      // From the best overlap to the worst, so that the weights fall.
      for (uint32_t distance = 0; distance <= highest - lowest; ++distance) {
        const uint32_t overlap = largest_is_best ? highest - distance : lowest + distance;
        const int count = Members(overlap);
        if (count == 0) continue;
        products += static_cast<uint64_t>(overlap) * count;
        total += weight[distance] * static_cast<float>(count);
        AddGroup(values, members_, blocks_, lanes, weight[distance], sums_);
      }
    }
    const float inverse = 1.0f / total;
    for (int k = 0; k < window_.head_size; ++k) y[k] = sums_[k] * inverse;
    return products;
  }

 private:
  int CountMembers(const uint32_t* members) const {
    int count = 0;
    for (int b = 0; b < blocks_; ++b)
      count += __builtin_popcount(members[b]);  // the target's own instruction
    return count;
  }

  // Collects the valid slots at this overlap.
  int Members(uint32_t overlap) {
    for (int b = 0; b < blocks_; ++b)
      members_[b] = window_.valid[b] & SlotsAt(overlaps_ + 32 * b, overlap);
    return CountMembers(members_);
  }

  // The lowest and the highest overlap among the valid slots.
  std::pair<uint32_t, uint32_t> Range() const {
    const U32 du;
    auto low = hn::Set(du, ~0u);
    auto high = hn::Zero(du);
    for (int slot = 0; slot < window_.slots; slot += kVector) {
      uint8_t packed[8] = {};
      const uint32_t bits = window_.valid[slot / 32] >> (slot % 32);
      packed[0] = static_cast<uint8_t>(bits);
      packed[1] = static_cast<uint8_t>(bits >> 8);
      const auto valid = hn::LoadMaskBits(du, packed);
      const auto overlap = hn::LoadU(du, overlaps_ + slot);
      low = hn::Min(low, hn::IfThenElse(valid, overlap, hn::Set(du, ~0u)));
      high = hn::Max(high, hn::IfThenElseZero(valid, overlap));
    }
    return {hn::GetLane(hn::MinOfLanes(du, low)), hn::GetLane(hn::MaxOfLanes(du, high))};
  }

  const AttentionWindow& window_;
  const int blocks_;
  uint32_t* overlaps_;
  uint32_t* members_;
  float* sums_;
};

uint64_t AttendImpl(const AttentionWindow& window, const uint32_t* query, const float* weight,
                    const float* scale, float* y) {
  thread_local std::vector<uint32_t> scratch;
  thread_local std::vector<float> sums;
  const int blocks = window.slots / 32;
  scratch.resize(window.slots + blocks);
  sums.resize(32 * window.words);
  HeadAttention head_attention(window, scratch.data(), scratch.data() + window.slots, sums.data());
  uint64_t products = 0;
  for (int i = 0; i < window.ticks * window.heads; ++i) {
    const int head = i % window.heads;
    products +=
        head_attention.Run(window.keys + static_cast<size_t>(i) * window.words * window.slots,
                           window.values + static_cast<size_t>(i) * blocks * 32 * window.words,
                           query + static_cast<size_t>(i) * window.words,
                           weight + static_cast<size_t>(head) * (window.head_size + 1),
                           scale[head] >= 0.0f, y + static_cast<size_t>(i) * window.head_size);
  }
  return products;
}

void StoreValuesImpl(const uint32_t* bits, int slot, const AttentionWindow& window,
                     uint32_t* values) {
  const U32 du;
  const int blocks = window.slots / 32;
  const int lanes = 32 * window.words;
  const auto bit = hn::Set(du, 1u << (slot % 32));
  for (int i = 0; i < window.ticks * window.heads; ++i) {
    uint32_t* block = values + (static_cast<size_t>(i) * blocks + slot / 32) * lanes;
    for (int lane = 0; lane < lanes; lane += kVector) {
      const uint32_t word = bits[static_cast<size_t>(i) * window.words + lane / 32] >> (lane % 32);
      const uint8_t packed[8] = {static_cast<uint8_t>(word), static_cast<uint8_t>(word >> 8)};
      const auto others = hn::AndNot(bit, hn::LoadU(du, block + lane));
      const auto own = hn::IfThenElseZero(hn::LoadMaskBits(du, packed), bit);
      hn::StoreU(hn::Or(others, own), du, block + lane);
    }
  }
}

}  // namespace
}  // namespace HWY_NAMESPACE
}  // namespace spikeserve::kernels
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace spikeserve::kernels {

HWY_EXPORT(CoderPeriodsImpl);
HWY_EXPORT(SumRowsImpl);
HWY_EXPORT(LifBitsImpl);
HWY_EXPORT(LifCountsImpl);
HWY_EXPORT(AffineImpl);
HWY_EXPORT(AffineTicksImpl);
HWY_EXPORT(SoftmaxImpl);
HWY_EXPORT(GateHeadsImpl);
HWY_EXPORT(CountBitsImpl);
HWY_EXPORT(LayerNormImpl);
HWY_EXPORT(AttendImpl);
HWY_EXPORT(StoreValuesImpl);

void CoderPeriods(const Lif& lif, const float* x, const float* gain, const float* bias, int size,
                  int ticks, int32_t* periods) {
  HWY_DYNAMIC_DISPATCH(CoderPeriodsImpl)(lif, x, gain, bias, size, ticks, periods);
}

void SumRows(const PackedLinear& linear, const int32_t* members, int count, int width, float* sum) {
  HWY_DYNAMIC_DISPATCH(SumRowsImpl)(linear, members, count, width, sum);
}

void LifBits(const Lif& lif, const float* bias, const Drive& drive, int width, uint32_t* bits) {
  HWY_DYNAMIC_DISPATCH(LifBitsImpl)(lif, bias, drive, width, bits);
}

void LifCounts(const Lif& lif, const float* bias, const Drive& drive, int width, float* counts) {
  HWY_DYNAMIC_DISPATCH(LifCountsImpl)(lif, bias, drive, width, counts);
}

uint64_t Affine(const PackedLinear& linear, const float* input, float* output) {
  return HWY_DYNAMIC_DISPATCH(AffineImpl)(linear, input, output);
}

uint64_t AffineTicks(const PackedLinear& linear, const float* input, int stride, int ticks,
                     float* output) {
  return HWY_DYNAMIC_DISPATCH(AffineTicksImpl)(linear, input, stride, ticks, output);
}

void Softmax(float* rows, int count, int stride, int size) {
  HWY_DYNAMIC_DISPATCH(SoftmaxImpl)(rows, count, stride, size);
}

void GateHeads(const HeadOutputs& heads, const float* gates, int stride, bool concat,
               float* merged) {
  HWY_DYNAMIC_DISPATCH(GateHeadsImpl)(heads, gates, stride, concat, merged);
}

uint64_t CountBits(const uint32_t* words, int count) {
  return HWY_DYNAMIC_DISPATCH(CountBitsImpl)(words, count);
}

void LayerNorm(const float* weight, const float* bias, float* x, int size) {
  HWY_DYNAMIC_DISPATCH(LayerNormImpl)(weight, bias, x, size);
}

uint64_t Attend(const AttentionWindow& window, const uint32_t* query, const float* weight,
                const float* scale, float* y) {
  return HWY_DYNAMIC_DISPATCH(AttendImpl)(window, query, weight, scale, y);
}

void StoreValues(const uint32_t* bits, int slot, const AttentionWindow& window, uint32_t* values) {
  HWY_DYNAMIC_DISPATCH(StoreValuesImpl)(bits, slot, window, values);
}

std::vector<std::string> SupportedTargets() {
  std::vector<std::string> names;
  for (const int64_t target : hwy::SupportedAndGeneratedTargets())
    names.emplace_back(hwy::TargetName(target));
  return names;
}

void ForceTargetForTest(const std::string& name) {
  hwy::SetSupportedTargetsForTest(0);
  if (name.empty()) return;
  for (const int64_t target : hwy::SupportedAndGeneratedTargets()) {
    if (name == hwy::TargetName(target)) return hwy::SetSupportedTargetsForTest(target);
  }
}

}  // namespace spikeserve::kernels
#endif  // HWY_ONCE
