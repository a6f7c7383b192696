#include "server/messages/explain_convert.h"

#include <string>

#include "absl/synchronization/mutex.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "server/messages/convert.h"
#include "server/messages/step_convert.h"

namespace spikeserve {
namespace {

void ToProto(const TokenName& name, v1::Token* token) {
  switch (name.kind) {
    case TokenKind::kReturn:
      token->set_kind(v1::Token::RETURN_TO_GO);
      break;
    case TokenKind::kState:
      token->set_kind(v1::Token::STATE);
      break;
    case TokenKind::kAction:
      token->set_kind(v1::Token::ACTION);
      break;
  }
  token->set_timestep(name.timestep);
}

void ToProto(const PopulationTrace& population, v1::SpikeRaster* raster) {
  raster->set_stage(std::string(ToString(population.stage)));
  if (population.layer != kNoLayer) raster->set_layer(population.layer);
  ToProto(population.token, raster->mutable_token());
  const auto ticks = static_cast<int>(population.spikes.size());
  const auto neurons = static_cast<int>(population.spikes[0].size());
  raster->set_population(neurons);
  for (int tick = 0; tick < ticks; ++tick) {
    for (int neuron = 0; neuron < neurons; ++neuron) {
      if (population.spikes[static_cast<size_t>(tick)][static_cast<size_t>(neuron)] == 0) continue;
      raster->add_ticks(tick);
      raster->add_neurons(neuron);
    }
  }
}

void ToProto(const LayerTrace& trace, int layer, int ticks, v1::ExplainResponse* response) {
  v1::Attention* attention = response->add_attention();
  attention->set_layer(layer);
  attention->set_ticks(ticks);
  for (const TokenName& key : trace.keys) ToProto(key, attention->add_keys());
  attention->mutable_weights()->Add(trace.attention.begin(), trace.attention.end());
  if (trace.gated.empty()) return;
  v1::RoutingGates* routing = response->add_routing();
  routing->set_layer(layer);
  for (const TokenName& token : trace.gated) ToProto(token, routing->add_tokens());
  routing->mutable_gates()->Add(trace.gates.begin(), trace.gates.end());
}

}  // namespace

v1::ExplainResponse DecisionToProto(const ServedPolicy& served, const Session& session) {
  SPIKESERVE_DCHECK(session.last_answer.has_value());
  SPIKESERVE_DCHECK(!session.history.empty());
  const ModelConfig& config = served.policy().config;
  const Answer& answer = *session.last_answer;
  const auto observation = session.history.observation(session.history.size() - 1);
  v1::ExplainResponse response;
  response.set_session_id(session.id);
  response.set_policy(served.name);
  response.set_version(served.version);
  response.set_mode(std::string(ToString(config.mode)));
  response.set_layers(config.layers);
  response.set_heads(config.heads);
  response.set_ticks(config.is_dense() ? 1 : config.ticks);
  response.set_episode(session.episode);
  response.mutable_observation()->Add(observation.begin(), observation.end());
  ToProto(session.id, answer, served.policy(), response.mutable_answer());
  response.mutable_logits()->Add(answer.logits.begin(), answer.logits.end());
  return response;
}

v1::ExplainResponse ToProto(const ServedPolicy& served, const Session& session,
                            const Explanation& explanation) {
  v1::ExplainResponse response = DecisionToProto(served, session);
  response.mutable_readout()->Add(explanation.readout.begin(), explanation.readout.end());
  for (const PopulationTrace& population : explanation.trace.populations) {
    ToProto(population, response.add_rasters());
  }
  for (size_t i = 0; i < explanation.trace.layers.size(); ++i) {
    ToProto(explanation.trace.layers[i], static_cast<int>(i), response.ticks(), &response);
  }
  return response;
}

absl::Status ExplainSession(SessionEntry& entry, v1::ExplainResponse* response) {
  Session session;
  {
    absl::MutexLock lock(&entry.mutex);
    session = entry.agent.session();
  }
  ASSIGN_OR_RETURN(const auto explanation,
                   Explain(entry.served->engine->CompletePolicy(), session));
  *response = ToProto(*entry.served, session, explanation);
  return absl::OkStatus();
}

}  // namespace spikeserve
