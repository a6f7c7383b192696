#include "core/engine/spiking/integer_attention.h"

#include <algorithm>
#include <bit>
#include <cstdlib>

#include "core/math/fixed_point.h"
#include "core/model/fixed_point_weights.h"

namespace spikeserve {
namespace {

// Sets y[k] to sums[k] / divisor with kGateFraction fraction bits, rounded as RoundDivide and
// limited to kLargestAttended. Returns the number of sums that are not 0. The numerators have less
// than 53 bits, so the quotients of doubles, rounded down, are those of integers.
int Scale(const int32_t* sums, int size, int64_t divisor, int16_t* y) {
  const auto half = static_cast<double>(divisor);
  const double twice = 2.0 * half;
  int scaled = 0;
  for (int k = 0; k < size; ++k) {
    const double numerator = static_cast<double>(sums[k]) * (2 << kGateFraction) + half;
    const auto quotient = static_cast<int32_t>(numerator / twice);
    y[k] = static_cast<int16_t>(std::min(quotient, kLargestAttended));
    scaled += sums[k] != 0;
  }
  return scaled;
}

}  // namespace

void IntegerAttention::Attend(const ModelConfig& config, const std::vector<int16_t>& scales,
                              const IntegerBand& band, const IntegerCache& cache,
                              const uint32_t* query, int16_t* y, Counts* counts) {
  const int size = config.head_size();
  for (int head = 0; head < config.heads; ++head) {
    const int first = head * size;
    int64_t weights = 0;
    if (FindOverlaps(config, band, cache, query, head, counts)) {
      weights = WeighKeys(config.attention, scales[head]);
    } else {
      counts->attention_bytes += static_cast<uint64_t>(size) * sizeof(int16_t);
    }
    if (weights == 0) {
      counts->attention_scalings +=
          Scale(cache.sums() + first, size, int64_t{band.tokens()} * config.ticks, y + first);
      continue;
    }
    sums_.assign(size, 0);
    for (int i = 0; i < band.tokens(); ++i) {
      const auto weight = static_cast<int32_t>(overlaps_[i]);
      const int nonzero = cache.nonzero(band.slot(i), head);
      if (weight == 0 || nonzero == 0) continue;
      counts->attention_products += nonzero;
      const int16_t* const values = cache.counts(band.slot(i)) + first;
      for (int k = 0; k < size; ++k) sums_[k] += weight * values[k];
    }
    counts->attention_scalings += Scale(sums_.data(), size, weights * config.ticks, y + first);
  }
}

bool IntegerAttention::FindOverlaps(const ModelConfig& config, const IntegerBand& band,
                                    const IntegerCache& cache, const uint32_t* query, int head,
                                    Counts* counts) {
  const int words = (config.head_size() + 31) / 32;
  active_.clear();
  for (int tick = 0; tick < config.ticks; ++tick) {
    const int first = (tick * config.heads + head) * words;
    for (int word = first; word < first + words; ++word) {
      if (query[word] != 0) active_.push_back(word);
    }
  }
  if (active_.empty()) return false;
  counts->softmax_terms += static_cast<uint64_t>(band.tokens());
  const int size = config.head_size();
  counts->attention_bytes += static_cast<uint64_t>(band.tokens()) *
                             static_cast<uint64_t>((config.ticks * size + 7) / 8 + size);
  overlaps_.assign(band.tokens(), 0);
  for (int i = 0; i < band.tokens(); ++i) {
    const uint32_t* const keys = cache.keys(band.slot(i));
    for (const int word : active_) overlaps_[i] += std::popcount(query[word] & keys[word]);
    counts->attention_products += static_cast<uint64_t>(overlaps_[i]);
  }
  return true;
}

int64_t IntegerAttention::WeighKeys(Attention attention, int64_t scale) {
  int64_t sum = 0;
  if (attention == Attention::kShiftmax) {
    const auto [lowest, highest] = std::minmax_element(overlaps_.begin(), overlaps_.end());
    const int64_t best = scale >= 0 ? *highest : *lowest;
    for (int64_t& overlap : overlaps_) {
      const int64_t octaves =
          RoundShift(std::abs(overlap - best) * std::abs(scale), kScaleFraction);
      overlap = octaves > 8 ? 0 : 256 >> octaves;
    }
  }
  for (const int64_t weight : overlaps_) sum += weight;
  return sum;
}

}  // namespace spikeserve
