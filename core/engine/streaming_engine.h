// The engine that serves: computes only a decision's new tokens.
//
// Earlier tokens live on as bits: a token's keys and values never change, so attention over the
// band reads them from a ring of N timesteps. A rate coder's neuron is one small integer (its
// period), and every weight row is read once per token, not once per spike. Thread-safety as in
// engine.h.
#ifndef CORE_ENGINE_STREAMING_ENGINE_H_
#define CORE_ENGINE_STREAMING_ENGINE_H_

#include <memory>

#include "core/engine/engine.h"
#include "core/engine/packed_weights.h"

namespace spikeserve {

class StreamingEngine : public Engine {
 public:
  explicit StreamingEngine(std::shared_ptr<const Policy> policy);

  const Policy& policy() const override { return *policy_; }
  std::unique_ptr<Context> NewContext(uint64_t seed, int64_t first_timestep) const override;
  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const override;
  void AppendAction(Context& context, absl::Span<const float> encoded_action) const override;

 private:
  std::shared_ptr<const Policy> policy_;
  PackedWeights packed_;
};

}  // namespace spikeserve

#endif  // CORE_ENGINE_STREAMING_ENGINE_H_
