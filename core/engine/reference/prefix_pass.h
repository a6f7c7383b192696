// What the two naive passes over an episode share: which tokens there are, which of them are
// counted and recorded, and which may attend to which. No arithmetic: each pass defines its own.
//
// Not thread-safe.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/engine/counting.h"
#include "core/engine/prefix_engine.h"
#include "core/engine/trace.h"

namespace spikeserve {

class PrefixPass {
 public:
  // The arguments must outlive the object. `trace` may be null.
  PrefixPass(const Policy& policy, const PrefixContext& context, Trace* trace)
      : policy_(policy),
        config_(policy.config),
        tokens_(context.tokens()),
        first_new_token_(context.first_new_token()),
        trace_(trace) {}

 protected:
  bool IsNew(size_t token) const { return token >= first_new_token_; }

  TokenName Name(size_t token) const { return {tokens_[token].kind, tokens_[token].timestep}; }

  void AddSpikes(size_t token, Stage stage, int layer, const SpikeTrain& train) {
    if (!IsNew(token)) return;
    counts_.spikes(stage) += CountSpikes(train);
    if (trace_ != nullptr) trace_->populations.push_back({stage, layer, Name(token), train});
  }

  // Returns whether the decision depends on this token's output of `layer`. Each later layer looks
  // back N - 1 timesteps.
  bool IsRead(size_t token, int layer) const {
    const int64_t reach = int64_t{config_.layers - 1 - layer} * (config_.context - 1);
    return tokens_[token].timestep >= tokens_.back().timestep - reach;
  }

  // Returns whether token i may attend to token j <= i.
  bool IsInBand(size_t i, size_t j) const {
    return tokens_[j].timestep > tokens_[i].timestep - config_.context;
  }

  // Records which tokens the last token attends to. Called once per layer.
  void RecordKeys(int layer, size_t i) {
    if (trace_ == nullptr || i + 1 != tokens_.size()) return;
    for (size_t j = 0; j <= i; ++j) {
      if (IsInBand(i, j)) trace_->layers[layer].keys.push_back(Name(j));
    }
  }

  const Policy& policy_;
  const ModelConfig& config_;
  const std::vector<Token>& tokens_;
  const size_t first_new_token_;
  Trace* const trace_;  // may be null
  Counts counts_;
};

}  // namespace spikeserve
