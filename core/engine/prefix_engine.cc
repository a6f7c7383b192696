#include "core/engine/prefix_engine.h"

#include <algorithm>

#include "core/contract/dcheck.h"

namespace spikeserve {

void PrefixContext::AppendReturnAndState(const Policy& policy, float return_to_go,
                                         absl::Span<const float> observation) {
  SPIKESERVE_DCHECK(tokens_.empty() || tokens_.back().kind == TokenKind::kAction);
  tokens_.push_back(ReturnToken(policy, timestep_, return_to_go));
  tokens_.push_back(StateToken(policy, timestep_, observation, &previous_observation_));
}

void PrefixContext::AppendAction(absl::Span<const float> encoded_action) {
  SPIKESERVE_DCHECK(!tokens_.empty() && tokens_.back().kind == TokenKind::kState);
  tokens_.push_back(ActionToken(timestep_, encoded_action));
  ++timestep_;
}

size_t PrefixContext::first_new_token() const {
  return tokens_.size() - std::min<size_t>(tokens_.size(), kTokensPerTimestep);
}

std::unique_ptr<Engine::Context> PrefixEngine::NewContext(int64_t first_timestep) const {
  return std::make_unique<PrefixContext>(first_timestep);
}

void PrefixEngine::Decide(Context& context, float return_to_go, absl::Span<const float> observation,
                          Output* output) const {
  auto& prefix = static_cast<PrefixContext&>(context);
  prefix.AppendReturnAndState(*policy_, return_to_go, observation);
  Compute(prefix, output);
}

void PrefixEngine::AppendAction(Context& context, absl::Span<const float> encoded_action) const {
  static_cast<PrefixContext&>(context).AppendAction(encoded_action);
}

}  // namespace spikeserve
