#include "core/engine/spiking/integer_attention.h"

#include <numeric>

#include "core/engine/spiking/packed/packed_linear.h"

namespace spikeserve {

void IntegerAttention::Attend(const ModelConfig& config, const std::vector<int16_t>& scales,
                              const IntegerBand& band, const IntegerCache& cache,
                              const uint32_t* query, int16_t* y, Counts* counts) {
  const int size = config.head_size();
  const int tokens = band.tokens();
  slots_.resize(tokens);
  for (int i = 0; i < tokens; ++i) slots_[i] = band.slot(i);
  for (int head = 0; head < config.heads; ++head) {
    const int first = head * size;
    int32_t weights = 0;
    if (FindOverlaps(config, cache, query, head, counts)) {
      weights = config.attention == Attention::kShiftmax
                    ? kernels::Shiftmax(scales[head], tokens, overlaps_.data())
                    : std::accumulate(overlaps_.begin(), overlaps_.begin() + tokens, 0);
    } else {
      counts->attention_bytes += static_cast<uint64_t>(size) * sizeof(int16_t);
    }
    if (weights == 0) {
      counts->attention_scalings +=
          kernels::ScaleSums(cache.sums() + first, size, tokens * config.ticks, y + first);
      continue;
    }
    WeighValues(config, cache, head, counts);
    counts->attention_scalings +=
        kernels::ScaleSums(sums_.data(), size, weights * config.ticks, y + first);
  }
}

bool IntegerAttention::FindOverlaps(const ModelConfig& config, const IntegerCache& cache,
                                    const uint32_t* query, int head, Counts* counts) {
  query_.resize(cache.key_words());
  if (!JoinTicks(config, query, head, query_.data())) return false;
  const auto tokens = static_cast<int>(slots_.size());
  counts->softmax_terms += static_cast<uint64_t>(tokens);
  const int size = config.head_size();
  counts->attention_bytes +=
      static_cast<uint64_t>(tokens) * static_cast<uint64_t>((config.ticks * size + 7) / 8 + size);
  overlaps_.resize(PadToLanes(tokens));
  counts->attention_products +=
      kernels::Overlaps(query_.data(), cache.key_words(), cache.keys(head), cache.key_stride(),
                        slots_, overlaps_.data());
  return true;
}

void IntegerAttention::WeighValues(const ModelConfig& config, const IntegerCache& cache, int head,
                                   Counts* counts) {
  const int size = config.head_size();
  values_.clear();
  for (size_t i = 0; i < slots_.size(); ++i) {
    const int nonzero = cache.nonzero(slots_[i], head);
    if (overlaps_[i] == 0 || nonzero == 0) continue;
    counts->attention_products += static_cast<uint64_t>(nonzero);
    values_.push_back({cache.counts(slots_[i]) + head * size, overlaps_[i]});
  }
  sums_.resize(PadToLanes(size));
  kernels::WeighValues(values_, size, sums_.data());
}

}  // namespace spikeserve
