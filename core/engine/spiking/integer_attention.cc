#include "core/engine/spiking/integer_attention.h"

#include <algorithm>
#include <utility>

#include "core/engine/spiking/packed/packed_linear.h"
#include "core/engine/token_costs.h"

namespace spikeserve {
void GroupTicks(const IntegerKeys& keys, std::vector<TickGroup>* groups) {
  groups->clear();
  TickGroup silent;
  const ModelConfig& config = keys.config;
  const size_t words =
      static_cast<size_t>(config.plane_ticks()) * config.heads * keys.cache.words();
  for (int plane = 0; plane < config.attention_planes(); ++plane) {
    const uint32_t* const own = keys.query == nullptr ? nullptr : keys.query + plane * words;
    if (own != nullptr && std::any_of(own, own + words, [](uint32_t word) { return word != 0; })) {
      groups->push_back({plane});
    } else {
      silent.push_back(plane);
    }
  }
  if (!silent.empty()) groups->push_back(std::move(silent));
}

void IntegerAttention::Attend(const IntegerKeys& keys, const TickGroup& group, int16_t* y,
                              Counts* counts) {
  const ModelConfig& config = keys.config;
  const int ticks = static_cast<int>(group.size()) * config.plane_ticks();
  const auto scale = [&](const int32_t* sums, int first, int size, int32_t weights) {
    counts->attention_scalings += kernels::ScaleSums(sums, size, weights * ticks, y + first);
  };
  if (keys.query == nullptr) {  // all heads at once
    const int32_t* const sums = SumAllValues(keys, group, 0, config.hidden_size, counts);
    return scale(sums, 0, config.hidden_size, keys.band.tokens());
  }
  const int size = keys.cache.head_size();
  for (int head = 0; head < config.heads; ++head) {
    ReadQuery(keys, group, head);
    if (query_.empty()) {
      const int32_t* const sums = SumAllValues(keys, group, head * size, size, counts);
      scale(sums, head * size, size, keys.band.tokens());
    } else {
      const int32_t weights = WeighKeys(keys, group, head, counts);
      scale(SumValues(keys, group, head, counts), head * size, size, weights);
    }
  }
}

const int32_t* IntegerAttention::SumValues(const IntegerKeys& keys, const TickGroup& group,
                                           int head, Counts* counts) {
  plane_.resize(PadToLanes(keys.cache.head_size()));
  return SumPlanes(group, keys.cache.head_size(), [&](int plane) {
    counts->attention_products += kernels::WeighValues(
        weights_.data(), keys.cache.head(head, plane), keys.band.used_slots(), plane_.data());
    return plane_.data();
  });
}

const int32_t* IntegerAttention::SumAllValues(const IntegerKeys& keys, const TickGroup& group,
                                              int first, int size, Counts* counts) {
  counts->attention_bytes += group.size() * static_cast<uint64_t>(size) * sizeof(int16_t);
  return SumPlanes(group, size, [&](int plane) {
    const int32_t* const values = keys.cache.sums(plane) + first;
    if (plane != group.front()) {
      counts->attention_products +=
          static_cast<uint64_t>(size - std::count(values, values + size, 0));
    }
    return values;
  });
}

template <class SumsOf>
const int32_t* IntegerAttention::SumPlanes(const TickGroup& group, int size, SumsOf sums_of) {
  if (group.size() == 1) return sums_of(group.front());
  AssignZeros(&sums_, PadToLanes(size));
  for (const int plane : group) {
    const int32_t* const values = sums_of(plane);
    for (int k = 0; k < size; ++k) sums_[k] += values[k];
  }
  return sums_.data();
}

void IntegerAttention::ReadQuery(const IntegerKeys& keys, const TickGroup& group, int head) {
  query_.clear();
  const int words = keys.cache.words();
  const int tick_words = keys.config.heads * words;
  const int ticks = keys.config.plane_ticks();
  for (const int plane : group) {
    const uint32_t* own = keys.query + plane * ticks * tick_words + head * words;
    for (int word = 0; word < words; ++word, ++own) {
      for (int tick = 0; tick < ticks; ++tick) {
        const uint32_t bits = own[tick * tick_words];
        if (bits != 0) query_.push_back({(plane * ticks + tick) * words + word, bits});
      }
    }
  }
}

int32_t IntegerAttention::WeighKeys(const IntegerKeys& keys, const TickGroup& group, int head,
                                    Counts* counts) {
  const ModelConfig& config = keys.config;
  const IntegerBand& band = keys.band;
  const auto tokens = static_cast<uint64_t>(band.tokens());
  const int ticks = static_cast<int>(group.size()) * config.plane_ticks();
  counts->softmax_terms += tokens;
  const int size = keys.cache.head_size();
  counts->attention_bytes += tokens * (SpikeBytes(ticks, size) + ValueBytes(config, ticks, size));
  const int slots = band.used_slots();
  overlaps_.resize(slots);
  weights_.resize(slots);
  const kernels::HeadSlots own = keys.cache.head(head, group.front());
  counts->attention_products +=
      kernels::Overlaps(query_, own, band.held(), slots, overlaps_.data());
  const int32_t scale = keys.scales[head];
  return kernels::Shiftmax(scale, overlaps_.data(), band.held(), slots, weights_.data());
}

}  // namespace spikeserve
