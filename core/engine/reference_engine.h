// The SNN-DT as naive loops straight from the equations: the definition of every sum's order.
//
// It recomputes the whole episode at every decision and shares no arithmetic with the streaming
// engine beyond the neuron, LayerNorm and the exponential. Slow by design; for tests. Thread-safety
// as in engine.h.
#ifndef CORE_ENGINE_REFERENCE_ENGINE_H_
#define CORE_ENGINE_REFERENCE_ENGINE_H_

#include <memory>
#include <vector>

#include "core/engine/engine.h"
#include "core/engine/token.h"

namespace spikeserve {

// Spikes of a population over the ticks of one token: [T][neurons] of 0 and 1.
using SpikeTrain = std::vector<std::vector<uint8_t>>;

// The tokens of an episode so far, for engines that recompute.
class PrefixContext : public Engine::Context {
 public:
  PrefixContext(uint64_t seed, int64_t first_timestep) : seed_(seed), timestep_(first_timestep) {}

  uint64_t seed() const { return seed_; }
  const std::vector<Token>& tokens() const { return tokens_; }
  void AppendReturnAndState(const Policy& policy, float return_to_go,
                            absl::Span<const float> observation);
  void AppendAction(absl::Span<const float> encoded_action);
  // Index of the first token whose cost the running decision bears: a_{t-1}, or G_t where it opens
  // the context.
  size_t first_new_token() const;

 private:
  uint64_t seed_;
  int64_t timestep_;
  std::vector<Token> tokens_;
};

class ReferenceEngine : public Engine {
 public:
  explicit ReferenceEngine(std::shared_ptr<const Policy> policy) : policy_(std::move(policy)) {}

  const Policy& policy() const override { return *policy_; }
  std::unique_ptr<Context> NewContext(uint64_t seed, int64_t first_timestep) const override;
  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const override;
  void AppendAction(Context& context, absl::Span<const float> encoded_action) const override;

 private:
  std::shared_ptr<const Policy> policy_;
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_REFERENCE_ENGINE_H_
