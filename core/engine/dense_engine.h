// `dense` mode: an ordinary decision transformer (Chen et al., 2021) of the same size, for
// comparison.
//
// Tokens, band and residual structure are the SNN-DT's; a learned timestep embedding is added
// before the modality's LayerNorm, attention is softmax(q k / sqrt(d_h)) v over analog vectors,
// heads stand side by side, and the FFN is a GELU (tanh form; Hendrycks & Gimpel, 2016). Every
// product is a multiply-accumulate. Thread-safety as in engine.h.
#ifndef CORE_ENGINE_DENSE_ENGINE_H_
#define CORE_ENGINE_DENSE_ENGINE_H_

#include <memory>

#include "core/engine/engine.h"

namespace spikeserve {

// Recomputes every token of the episode at every decision.
class DenseReferenceEngine : public Engine {
 public:
  explicit DenseReferenceEngine(std::shared_ptr<const Policy> policy)
      : policy_(std::move(policy)) {}

  const Policy& policy() const override { return *policy_; }
  std::unique_ptr<Context> NewContext(uint64_t seed, int64_t first_timestep) const override;
  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const override;
  void AppendAction(Context& context, absl::Span<const float> encoded_action) const override;

 private:
  std::shared_ptr<const Policy> policy_;
};

// Keeps keys and values of the last N timesteps and computes only the new tokens.
class DenseStreamingEngine : public Engine {
 public:
  explicit DenseStreamingEngine(std::shared_ptr<const Policy> policy)
      : policy_(std::move(policy)) {}

  const Policy& policy() const override { return *policy_; }
  std::unique_ptr<Context> NewContext(uint64_t seed, int64_t first_timestep) const override;
  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const override;
  void AppendAction(Context& context, absl::Span<const float> encoded_action) const override;

 private:
  std::shared_ptr<const Policy> policy_;
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_DENSE_ENGINE_H_
