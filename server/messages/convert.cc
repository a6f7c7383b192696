#include "server/messages/convert.h"

#include <optional>
#include <string>

#include "core/action/action_space.h"
#include "core/agent/step.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/learning/frobenius_norm.h"
#include "core/math/vector_view.h"
#include "nlohmann/json.hpp"
#include "server/messages/step_convert.h"

namespace spikeserve {
namespace {

// Returns `rounding_loss.share` of a policy file's training record, if the record has it.
std::optional<double> LostByRounding(const Policy& policy) {
  const auto json =
      nlohmann::json::parse(policy.training, /*cb=*/nullptr, /*allow_exceptions=*/false);
  const nlohmann::json::json_pointer share("/rounding_loss/share");
  if (!json.contains(share) || !json.at(share).is_number()) return std::nullopt;
  return json.at(share).get<double>();
}

absl::StatusOr<LearningRequest> LearningFromProto(const v1::LearningConfig& config) {
  if (!v1::LearningConfig::Scope_IsValid(config.scope())) {
    return InvalidArgument("learning.scope", "SESSION or FLEET", static_cast<int>(config.scope()));
  }
  LearningRequest request;
  request.scope = config.scope() == v1::LearningConfig::FLEET ? Scope::kFleet : Scope::kSession;
  request.rule = config.rule();
  request.modulator = config.modulator();
  if (config.has_learning_rate()) request.learning_rate = config.learning_rate();
  if (config.has_trace_decay()) request.trace_decay = config.trace_decay();
  if (config.has_discount()) request.discount = config.discount();
  if (config.has_clip()) request.clip = config.clip();
  if (config.has_max_drift()) request.max_drift = config.max_drift();
  if (config.has_guard_margin()) request.guard_margin = config.guard_margin();
  if (config.has_verdict_seconds()) request.verdict_seconds = config.verdict_seconds();
  return request;
}

}  // namespace

v1::Durability ToProto(Durability durability) {
  switch (durability) {
    case Durability::kAsync:
      return v1::ASYNC;
    case Durability::kSync:
      return v1::SYNC;
    case Durability::kNone:
      break;
  }
  return v1::NONE;
}

absl::StatusOr<SessionRequest> RequestFromProto(const v1::OpenSessionRequest& request) {
  SessionRequest settings;
  if (request.has_target_return()) settings.target_return = request.target_return();
  settings.seed = request.seed();
  if (!v1::ActionSelection_IsValid(request.action_selection())) {
    return InvalidArgument("action_selection", "GREEDY or SAMPLE",
                           static_cast<int>(request.action_selection()));
  }
  settings.sample = request.action_selection() == v1::SAMPLE;
  if (request.has_temperature()) settings.temperature = request.temperature();
  if (request.has_learning()) {
    ASSIGN_OR_RETURN(settings.learning, LearningFromProto(request.learning()));
  }
  settings.head_delta = AsVector(request.head_delta());
  return settings;
}

v1::ActionSpace ToProto(const ActionSpace& space) {
  v1::ActionSpace proto;
  if (space.is_discrete()) {
    proto.mutable_discrete()->set_n(space.n);
  } else {
    proto.mutable_box()->mutable_low()->Add(space.low.begin(), space.low.end());
    proto.mutable_box()->mutable_high()->Add(space.high.begin(), space.high.end());
  }
  return proto;
}

namespace {

void ToProto(const std::vector<Feature>& features,
             google::protobuf::RepeatedPtrField<v1::Feature>* proto) {
  for (const Feature& feature : features) {
    v1::Feature& added = *proto->Add();
    added.set_name(feature.name);
    added.set_unit(feature.unit);
    if (feature.low.has_value()) added.set_low(*feature.low);
    if (feature.high.has_value()) added.set_high(*feature.high);
    added.set_frame(feature.frame);
  }
}

}  // namespace

v1::PolicyInfo ToProto(const CatalogPolicy& entry, const ServedPolicy& served) {
  SPIKESERVE_DCHECK(entry.versions.contains(served.version));
  const Policy& policy = served.policy();
  v1::PolicyInfo proto;
  proto.set_name(served.name);
  proto.set_version(served.version);
  proto.set_is_default(served.version == entry.DefaultVersion());
  proto.set_observation_size(policy.observation_size());
  *proto.mutable_action_space() = ToProto(policy.action_space);
  proto.set_context_length(policy.config.context);
  proto.set_target_return(static_cast<double>(policy.target_return));
  if (const auto mean = TrainingReturn(policy)) proto.set_training_return(*mean);
  if (const auto lost = LostByRounding(policy)) proto.set_rounding_loss(*lost);
  proto.set_environment(policy.environment);
  proto.set_mode(std::string(ToString(policy.config.mode)));
  for (const auto& [label, version] : entry.settings.labels) {
    if (version == served.version) proto.add_version_labels(label);
  }
  if (!entry.settings.shares.empty()) {
    proto.set_traffic_percent(entry.settings.PercentOf(served.version));
  }
  proto.set_is_shadow(served.version == entry.settings.shadow_version);
  ToProto(NeutralAction(policy.action_space), policy.action_space.is_discrete(),
          proto.mutable_neutral_action());
  ToProto(policy.features.observation, proto.mutable_observation_features());
  ToProto(policy.features.action, proto.mutable_action_features());
  if (policy.features.rate_hz.has_value()) {
    proto.set_rate_hz(*policy.features.rate_hz);
    proto.set_rate_tolerance(policy.features.rate_tolerance);
  }
  proto.set_checks_wiring(policy.wiring != nullptr);
  return proto;
}

void ToProto(const Corrections& corrections, v1::Corrections* proto) {
  proto->set_steps(corrections.steps);
  proto->set_disagreement(corrections.Disagreement());
  proto->set_start_disagreement(corrections.StartDisagreement());
}

v1::GetSessionResponse ToProto(const AgentSession& agent, bool include_head_delta) {
  const Session& session = agent.session();
  v1::GetSessionResponse proto;
  proto.set_session_id(session.id);
  proto.set_policy(session.options.policy);
  proto.set_version(session.options.version);
  proto.set_episode(session.episode);
  proto.set_step(session.step);
  proto.set_episode_return(session.episode_return);
  proto.set_return_to_go(session.return_to_go);
  proto.set_target_return(session.target_return);
  proto.set_spikes(session.spikes);
  proto.set_energy_joules(session.energy_joules);
  proto.set_decisions(session.decisions);
  proto.set_missing_rewards(agent.life().missing_rewards());
  proto.set_head_drift(agent.HeadDrift());
  if (include_head_delta) {
    const Eigen::VectorXf delta = agent.HeadDelta();
    proto.mutable_head_delta()->Add(delta.begin(), delta.end());
  }
  if (session.learner.has_value()) {
    proto.set_trace_norm(FrobeniusNorm(session.learner->trace));
    proto.set_modulator_mean(session.learner->returns.mean);
    proto.set_modulator_std(session.learner->returns.deviation());
    proto.set_rollbacks(agent.Rollbacks());
    if (session.learner->corrections.steps > 0) {
      ToProto(session.learner->corrections, proto.mutable_corrections());
    }
  }
  if (const auto& verdict = session.wiring.verdict) {
    *proto.mutable_wiring() = ToProto(*verdict, agent.policy());
  }
  proto.mutable_labels()->insert(session.options.labels.begin(), session.options.labels.end());
  return proto;
}

void ToProto(const std::string& session_id, const SessionOptions& options,
             const ServedPolicy& served, v1::OpenSessionResponse* response) {
  const Policy& policy = served.policy();
  response->set_session_id(session_id);
  response->set_policy(served.name);
  response->set_version(served.version);
  response->set_observation_size(policy.observation_size());
  *response->mutable_action_space() = ToProto(policy.action_space);
  response->set_context_length(policy.config.context);
  response->set_target_return(options.target_return);
  response->set_recording(options.recording);
  response->set_durability(ToProto(options.durability));
  response->set_history_limit(kHistoryLimit);
  ToProto(NeutralAction(policy.action_space), policy.action_space.is_discrete(),
          response->mutable_neutral_action());
  ToProto(policy.features.observation, response->mutable_observation_features());
  ToProto(policy.features.action, response->mutable_action_features());
}

}  // namespace spikeserve
