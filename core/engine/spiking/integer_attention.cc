#include "core/engine/spiking/integer_attention.h"

#include <algorithm>
#include <utility>

#include "core/engine/spiking/packed/packed_linear.h"
#include "core/engine/token_costs.h"

namespace spikeserve {
namespace {

int WordsOf(const ModelConfig& config) { return (config.head_size() + 31) / 32; }

}  // namespace

void GroupTicks(const IntegerKeys& keys, std::vector<TickGroup>* groups) {
  groups->clear();
  TickGroup silent;
  const ModelConfig& config = keys.config;
  const size_t words = static_cast<size_t>(config.plane_ticks()) * config.heads * WordsOf(config);
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
  const int size = config.head_size();
  const int ticks = static_cast<int>(group.size()) * config.plane_ticks();
  for (int head = 0; head < config.heads; ++head) {
    ReadQuery(keys, group, head);
    const bool is_mean = query_.empty() && keys.biases == nullptr;
    const int32_t weights = is_mean ? keys.band.tokens() : WeighKeys(keys, group, head, counts);
    SumValues(keys, group, head, is_mean, counts);
    counts->attention_scalings +=
        kernels::ScaleSums(sums_.data(), size, weights * ticks, y + head * size);
  }
}

void IntegerAttention::SumValues(const IntegerKeys& keys, const TickGroup& group, int head,
                                 bool is_mean, Counts* counts) {
  const int size = keys.config.head_size();
  sums_.assign(PadToLanes(size), 0);
  plane_.resize(sums_.size());
  if (is_mean) {
    counts->attention_bytes += group.size() * static_cast<uint64_t>(size) * sizeof(int16_t);
  }
  for (const int plane : group) {
    const int32_t* values = keys.cache.sums(plane) + head * size;
    if (!is_mean) {
      counts->attention_products += kernels::WeighValues(
          weights_.data(), keys.cache.head(head, plane), keys.band.used_slots(), plane_.data());
      values = plane_.data();
    } else if (plane != group.front()) {
      counts->attention_products +=
          static_cast<uint64_t>(size - std::count(values, values + size, 0));
    }
    for (int k = 0; k < size; ++k) sums_[k] += values[k];
  }
}

void IntegerAttention::ReadQuery(const IntegerKeys& keys, const TickGroup& group, int head) {
  query_.clear();
  if (keys.query == nullptr) return;
  const int words = WordsOf(keys.config);
  const int ticks = keys.config.plane_ticks();
  for (const int plane : group) {
    for (int tick = plane * ticks; tick < (plane + 1) * ticks; ++tick) {
      const uint32_t* const own =
          keys.query + (static_cast<size_t>(tick) * keys.config.heads + head) * words;
      for (int word = 0; word < words; ++word) {
        if (own[word] != 0) query_.push_back({tick * words + word, own[word]});
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
  const uint64_t key_bytes = query_.empty() ? 0 : SpikeBytes(ticks, config.head_size());
  counts->attention_bytes += tokens * (key_bytes + ValueBytes(config, ticks, config.head_size()));
  const int slots = band.used_slots();
  overlaps_.resize(slots);
  weights_.resize(slots);
  const kernels::HeadSlots own = keys.cache.head(head, group.front());
  counts->attention_products +=
      kernels::Overlaps(query_, own, band.held(), slots, overlaps_.data());
  const int32_t scale = keys.scales[head];
  if (keys.biases != nullptr) {
    counts->attention_products += tokens;
    const int16_t* const biases = keys.biases + 2 * head * band.slots();
    return kernels::BiasedShiftmax(scale, overlaps_.data(), biases + band.slots() - 1 - band.last(),
                                   band.held(), slots, weights_.data());
  }
  return kernels::Shiftmax(scale, overlaps_.data(), band.held(), slots, weights_.data());
}

}  // namespace spikeserve
