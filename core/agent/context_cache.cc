#include "core/agent/context_cache.h"

#include "absl/types/span.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

absl::Span<const float> Encode(const ActionSpace& space, const Action& action,
                               std::vector<float>* memory) {
  memory->resize(static_cast<size_t>(space.size()));
  space.Encode(action, absl::MakeSpan(*memory));
  return *memory;
}

}  // namespace

void ContextCache::Fill(const ServedPolicy& served, const Session& session) {
  if (context_ != nullptr) return;
  const Engine& engine = *served.engine;
  const History& history = session.history;
  const auto first_timestep = session.step - static_cast<int64_t>(history.size());
  context_ = engine.NewContext(first_timestep);
  is_pending_ = false;
  Engine::Output ignored;
  std::vector<float> encoded;
  for (size_t i = 0; i < history.size(); ++i) {
    engine.Decide(*context_, history.return_to_go(i), history.observation(i), &ignored);
    engine.AppendAction(*context_,
                        Encode(served.policy().action_space, history.action(i), &encoded));
  }
}

Engine::Context* ContextCache::StartDecision() {
  SPIKESERVE_DCHECK(context_ != nullptr && !is_pending_);
  is_pending_ = true;
  return context_.get();
}

Engine::TakenAction ContextCache::LastAction(const ServedPolicy& served, const Session& session,
                                             std::vector<float>* memory) const {
  SPIKESERVE_DCHECK(context_ != nullptr);
  thread_local Action action;  // reused, so that a warm decision allocates nothing
  session.history.action(session.history.size() - 1, &action);
  return {context_.get(), Encode(served.policy().action_space, action, memory)};
}

void ContextCache::OnExecuted() {
  if (!is_pending_) context_.reset();  // it holds the answered action
  expects_executed_ = true;
}

void ContextCache::Drop() {
  context_.reset();
  is_pending_ = false;
}

}  // namespace spikeserve
