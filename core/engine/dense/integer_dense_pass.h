// Computes the tokens of a dense policy in integer arithmetic (docs/design/integer.md).
//
// Weights and activations have 8 bits: every vector that meets a matrix, and every head's query,
// key and value, is rounded to 8 bits with a power of two as its own scale. Norms, residuals and
// the powers of two of the softmax are those of spiking policies in integer arithmetic.
#pragma once

#include <cstdint>
#include <deque>
#include <vector>

#include "core/engine/counts.h"
#include "core/engine/token.h"
#include "core/engine/trace.h"
#include "core/model/policy.h"

namespace spikeserve {

// Integers of 8 bits with a common scale: number k stands for values[k] * 2^exponent.
struct Block {
  std::vector<int32_t> values;  // -127 to 127
  int exponent = 0;             // 0 to 8
};

// Computes one token at a time, in the order of the sequence. `layers` [L] stores the keys and
// values of the earlier tokens. Not thread-safe.
class IntegerDensePass {
 public:
  // The keys and values of one token in one layer.
  struct KeyValue {
    TokenName token;
    std::vector<Block> keys;    // [H], each [d_h]
    std::vector<Block> values;  // [H], each [d_h]
  };
  // Those of one layer that a query may attend to, oldest first.
  using KeyValues = std::deque<KeyValue>;

  IntegerDensePass(const Policy& policy, std::vector<KeyValues>& layers);

  const Counts& counts() const { return counts_; }
  void ResetCounts() { counts_ = Counts(); }

  // Returns the token's output of the last layer [d], or an empty vector for returns and actions,
  // whose output of the last layer is not used. Records the token's attention in `trace` unless it
  // is null.
  std::vector<float> Run(const Token& token, Trace* trace = nullptr);

  // Counts the operations of the action head, which is applied to the output of the state token.
  void CountHead(const std::vector<float>& readout);

 private:
  using Integers = std::vector<int32_t>;

  Integers Embed(const Token& token);
  // Returns the saturated outputs of a map.
  Integers Map(const FixedPointMap& map, const Block& input);
  std::vector<Block> SplitHeads(const Integers& x) const;  // [H]
  void Store(KeyValues& tokens, const Token& token, const FixedPointLayer& layer,
             const Block& input);
  // Returns the concatenated outputs of the heads [d].
  Integers Attend(const std::vector<Block>& query, const KeyValues& tokens, LayerTrace* trace);
  // Returns the weights of the keys of a head, 0 to 255.
  Integers WeighKeys(const Block& query, const KeyValues& tokens, int head);
  void FeedForward(const FixedPointLayer& layer, Integers& x);
  void Normalize(const FixedPointNorm& norm, Integers& x);

  const Policy& policy_;
  const ModelConfig& config_;
  const int scale_;  // of a score, see kScoreFraction
  std::vector<KeyValues>& layers_;
  Counts counts_;
};

}  // namespace spikeserve
