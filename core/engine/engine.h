// Computes the decisions of one policy.
//
//   std::unique_ptr<Engine::Context> context = engine.NewContext();
//   engine.Decide(*context, return_to_go, observation, &output);  // writes output.readout
//   engine.AppendAction(*context, encoded_action);                // advances to timestep t + 1
//
// Engines are immutable and thread-safe. All state that changes is in a Context, which one caller
// at a time may use. A context is a cache: it can be rebuilt bit for bit from the last
// HistorySize() timesteps, because what a decision reads does not depend on anything older.
//
// Symbols: d hidden size, obs observation length, act action head outputs, t timestep within the
// episode.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "absl/types/span.h"
#include "core/engine/counts.h"
#include "core/model/policy.h"

namespace spikeserve {

// Interface of all engines.
class Engine {
 public:
  // Stores the tokens of one episode so far, in the form that the engine needs. A context holds no
  // reference to its engine, but may be passed only to the engine that created it.
  class Context {
   public:
    virtual ~Context() = default;
  };

  // The result of one decision, computed from the state token.
  struct Output {
    // [d]: firing rates in [0, 1] (spike count / T); in dense mode, the output of the last layer.
    std::vector<float> readout;
    // Cost of this decision, including the policy's own action head; see counts.h.
    Counts counts;
  };

  // The arguments of one Decide among several that are made together.
  struct Decision {
    Context* context = nullptr;
    float return_to_go = 0.0f;
    absl::Span<const float> observation;
    Output* output = nullptr;
  };

  // The arguments of one AppendAction among several that are made together.
  struct TakenAction {
    Context* context = nullptr;
    absl::Span<const float> encoded_action;
  };

  virtual ~Engine() = default;

  // Returns the policy. A compact engine (engine_factory.h) has freed the weights, biases and
  // thresholds of its maps, except those of the action head.
  virtual const Policy& policy() const = 0;

  // Returns a copy of the policy with all of its numbers.
  virtual Policy CompletePolicy() const { return policy(); }

  // Creates an empty context whose first token will belong to timestep `first_timestep`.
  virtual std::unique_ptr<Context> NewContext(int64_t first_timestep = 0) const = 0;

  // Appends the tokens G_t and s_t to `context` and writes the decision of timestep t into
  // `output`. `return_to_go` and `observation` [obs] are in environment units. REQUIRES: the last
  // call on `context` was NewContext or AppendAction; the inputs are finite.
  virtual void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
                      Output* output) const = 0;

  // Appends the token a_t to `context`, which advances to timestep t + 1. `encoded_action` [act] is
  // the output of ActionSpace::Encode. The cost is included in the counts of the next decision. May
  // run after the answer was sent. REQUIRES: the last call on `context` was Decide.
  virtual void AppendAction(Context& context, absl::Span<const float> encoded_action) const = 0;

  // As Decide and AppendAction, for several different contexts, with results that are equal bit for
  // bit. An engine may load its weights once for all contexts.
  virtual void DecideTogether(absl::Span<const Decision> decisions) const;
  virtual void AppendActionsTogether(absl::Span<const TakenAction> actions) const;
};

// Returns the number of timesteps that the decision at t depends on: L (N - 1) + 1, because each of
// the L layers looks back N - 1 timesteps. At least 2, because the counts of a decision include
// those of a_{t-1}. One more with observation changes: the oldest state token contains the change
// since the timestep before it.
int HistorySize(const ModelConfig& config);

}  // namespace spikeserve
