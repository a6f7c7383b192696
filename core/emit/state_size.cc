#include "core/emit/state_size.h"

#include <algorithm>

#include "core/engine/engine.h"

namespace spikeserve {
namespace {

constexpr int kTextBytes = 320;
constexpr int kEndBytes = 160;   // without the numbers of an observation and an action
constexpr int kNumberBytes = 5;  // in CBOR
constexpr int kCostsBytes = 23 * 4;

int64_t RoundUp(int64_t value, int64_t unit) { return (value + unit - 1) / unit * unit; }

}  // namespace

StateSize StateSizeOf(const Policy& policy) {
  const ModelConfig& config = policy.config;
  const int64_t d = config.hidden_size;
  const int64_t observations = policy.observation_size();
  const int64_t actions = policy.action_space.size();
  const int64_t slots = int64_t{3} * config.context;
  StateSize size;
  const int head = config.head_size();
  size.word_bits = head % 32 == 0 ? 32 : head % 16 == 0 ? 16 : 8;
  size.words = (head + size.word_bits - 1) / size.word_bits;
  size.widest = std::max(
      {config.hidden_size, config.ffn_size, config.has_routing() ? config.routing_hidden_size : 0,
       config.state_inputs(policy.observation_size()), policy.action_space.size()});
  size.text_bytes = kTextBytes;

  const int64_t action = 4 * (policy.action_space.is_discrete() ? 1 : actions);
  const int64_t words = int64_t{size.words} * config.ticks * config.heads;
  int64_t bytes = 10 * 8 + 11 * 4 + 4 + 2 * kCostsBytes + 4 + 4 * actions + action +
                  4 * actions * d + HistorySize(config) * (4 + 4 * observations + action);
  bytes += 4 * (d + size.widest + slots + config.heads);                  // x, sums, weights, gates
  bytes += words * size.word_bits / 8 * (2 * config.layers * slots + 1);  // keys, values, query
  bytes = RoundUp(bytes, 2) + 2 * (size.widest + int64_t{config.ticks} * size.widest);
  bytes += d + size.text_bytes;
  size.state_bytes = RoundUp(bytes + kEndBytes + kNumberBytes * (observations + actions), 8);
  size.end_bytes = static_cast<int>(size.state_bytes - bytes);
  return size;
}

}  // namespace spikeserve
