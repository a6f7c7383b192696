// Base class of the engines that recompute the whole episode at every decision.
#pragma once

#include <memory>
#include <utility>
#include <vector>

#include "core/engine/engine.h"
#include "core/engine/token.h"

namespace spikeserve {

// Stores every token of an episode, oldest first. Not thread-safe.
class PrefixContext : public Engine::Context {
 public:
  explicit PrefixContext(int64_t first_timestep) : timestep_(first_timestep) {}

  const std::vector<Token>& tokens() const { return tokens_; }
  // Returns the index of the first token whose cost belongs to the current decision: a_{t-1}, or
  // G_t if the context starts at timestep t.
  size_t first_new_token() const;

  void AppendReturnAndState(const Policy& policy, float return_to_go,
                            absl::Span<const float> observation);
  void AppendAction(absl::Span<const float> encoded_action);

 private:
  int64_t timestep_;
  std::vector<float> previous_observation_;  // see SetStateInput
  std::vector<Token> tokens_;
};

// An engine whose decision is a function of all tokens of the context. Thread-safe, like every
// engine.
class PrefixEngine : public Engine {
 public:
  explicit PrefixEngine(std::shared_ptr<const Policy> policy) : policy_(std::move(policy)) {}

  const Policy& policy() const final { return *policy_; }
  std::unique_ptr<Context> NewContext(int64_t first_timestep) const final;
  void Decide(Context& context, float return_to_go, absl::Span<const float> observation,
              Output* output) const final;
  void AppendAction(Context& context, absl::Span<const float> encoded_action) const final;

 private:
  // Computes the decision at the last token of `prefix`, which is a state token.
  virtual void Compute(const PrefixContext& prefix, Output* output) const = 0;

  std::shared_ptr<const Policy> policy_;
};

}  // namespace spikeserve
