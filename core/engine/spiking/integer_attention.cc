#include "core/engine/spiking/integer_attention.h"

#include "core/engine/spiking/packed/packed_linear.h"

namespace spikeserve {

void IntegerAttention::Attend(const ModelConfig& config, const std::vector<int16_t>& scales,
                              const int16_t* biases, const IntegerBand& band,
                              const IntegerCache& cache, const uint32_t* query, int16_t* y,
                              Counts* counts) {
  const int size = config.head_size();
  for (int head = 0; head < config.heads; ++head) {
    ReadQuery(config, query, head);
    const int32_t* sums = cache.sums() + head * size;
    int32_t weights = 0;
    if (query_.empty() && biases == nullptr) {
      counts->attention_bytes += static_cast<uint64_t>(size) * sizeof(int16_t);
    } else {
      const int16_t* const own = biases == nullptr ? nullptr : biases + 2 * head * band.slots();
      weights = WeighKeys(config, scales[head], own, band, cache.head(head), counts);
    }
    if (weights == 0) {
      weights = band.tokens();
    } else {
      sums_.resize(PadToLanes(size));
      counts->attention_products +=
          kernels::WeighValues(weights_.data(), cache.head(head), band.used_slots(), sums_.data());
      sums = sums_.data();
    }
    counts->attention_scalings +=
        kernels::ScaleSums(sums, size, weights * config.ticks, y + head * size);
  }
}

void IntegerAttention::ReadQuery(const ModelConfig& config, const uint32_t* query, int head) {
  query_.clear();
  if (query == nullptr) return;
  const int words = (config.head_size() + 31) / 32;
  for (int tick = 0; tick < config.ticks; ++tick) {
    const uint32_t* const own = query + (static_cast<size_t>(tick) * config.heads + head) * words;
    for (int word = 0; word < words; ++word) {
      if (own[word] != 0) query_.push_back({tick * words + word, own[word]});
    }
  }
}

int32_t IntegerAttention::WeighKeys(const ModelConfig& config, int32_t scale, const int16_t* biases,
                                    const IntegerBand& band, const kernels::HeadSlots& head,
                                    Counts* counts) {
  const auto tokens = static_cast<uint64_t>(band.tokens());
  const int size = config.head_size();
  counts->softmax_terms += tokens;
  const int key_bytes = query_.empty() ? 0 : (config.ticks * size + 7) / 8;
  counts->attention_bytes += tokens * static_cast<uint64_t>(key_bytes + size);
  const int slots = band.used_slots();
  overlaps_.resize(slots);
  weights_.resize(slots);
  counts->attention_products +=
      kernels::Overlaps(query_, head, band.held(), slots, overlaps_.data());
  if (biases != nullptr) {
    counts->attention_products += tokens;
    return kernels::BiasedShiftmax(scale, overlaps_.data(), biases + band.slots() - 1 - band.last(),
                                   band.held(), slots, weights_.data());
  }
  return kernels::Shiftmax(scale, overlaps_.data(), band.held(), slots, weights_.data());
}

}  // namespace spikeserve
