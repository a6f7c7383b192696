// An engine computes decisions of one policy.
//
// Engines are immutable and safe to share between threads; everything that changes lives in a
// Context, which one caller at a time may use. A context is a cache: it can be rebuilt from the
// last `history_size` timesteps, bit for bit, because a token's keys and values depend on nothing
// older.
//
// Symbols: d hidden size, obs observation length, act action head outputs, t timestep within the
// episode.
#ifndef CORE_ENGINE_ENGINE_H_
#define CORE_ENGINE_ENGINE_H_

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/types/span.h"
#include "core/engine/counts.h"
#include "core/model/policy.h"

namespace spikeserve {

class Engine {
 public:
  // The tokens of one episode seen so far, in whatever form the engine needs them. A context holds
  // no reference to its engine, but may be passed only to the engine that made it.
  class Context {
   public:
    virtual ~Context() = default;
  };

  // What the model says at a state token.
  struct Output {
    std::vector<float> readout;  // [d]: firing rates in [0, 1] (spike count / T); dense mode: the
                                 // last layer's output
    Counts counts;  // of this decision, the policy's own action head included; see counts.h
  };

  // One of several decisions made together.
  struct Decision {
    Context* context = nullptr;
    float return_to_go = 0.0f;
    absl::Span<const float> observation;
    Output* output = nullptr;
  };

  // One of several actions taken in together.
  struct TakenAction {
    Context* context = nullptr;
    absl::Span<const float> encoded_action;
  };

  virtual ~Engine() = default;

  virtual const Policy& policy() const = 0;

  // An empty context whose first token will be that of `first_timestep`. `seed` keys the Bernoulli
  // coder and is not used otherwise.
  virtual std::unique_ptr<Context> NewContext(uint64_t seed, int64_t first_timestep = 0) const = 0;

  // Takes in G_t and s_t and writes the decision of timestep t into `output`.
  // `return_to_go` and `observation` [obs] are in environment units.
  // REQUIRES: NewContext or AppendAction was the last call on `context`; finite inputs.
  virtual void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
                      Output* output) const = 0;

  // Takes in a_t, `encoded_action` [act] as ActionSpace::Encode writes it, and moves on to timestep
  // t + 1. What it spends is counted in the next decision. Nobody waits for it: it may run after
  // the answer was sent. REQUIRES: Decide was the last call on `context`.
  virtual void AppendAction(Context& context, absl::Span<const float> encoded_action) const = 0;

  // The same for many contexts, all distinct, with equal bits; an engine may fetch its weights once
  // for all of them.
  virtual void DecideTogether(absl::Span<const Decision> decisions) const;
  virtual void AppendActionsTogether(absl::Span<const TakenAction> actions) const;
};

// Timesteps that the decision at t depends on: L bands of N timesteps, overlapping by one, so L (N
// - 1) + 1; at least 2, since it pays for a_{t-1} too.
int HistorySize(const ModelConfig& config);

}  // namespace spikeserve

#endif  // CORE_ENGINE_ENGINE_H_
