#include "client/playground/playground.h"

#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/playground/decision_json.h"
#include "core/agent/explanation.h"
#include "core/agent/session_request.h"
#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "core/model/policy_file.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

std::shared_ptr<const ServedPolicy> Serve(Policy policy) {
  const auto shared = std::make_shared<const Policy>(std::move(policy));
  auto served = std::make_shared<ServedPolicy>();
  served->name = "policy";  // sessions need a name, but only a server has several policies
  served->version = 1;
  served->engine = MakeEngine(shared);
  served->heads = std::make_shared<TenantHeads>(shared);
  served->observer = std::make_shared<SessionObserver>();
  return served;
}

absl::Status CheckFits(const Policy& policy, const Environment& environment) {
  if (policy.observation_size() == environment.observation_size() &&
      policy.action_space == environment.action_space()) {
    return absl::OkStatus();
  }
  return absl::InvalidArgumentError(
      absl::StrCat("policy: expected the ", environment.observation_size(),
                   " observations and the actions of ", environment.id(), ", received ",
                   policy.observation_size(), " observations, or other actions"));
}

}  // namespace

absl::StatusOr<std::unique_ptr<Playground>> Playground::Open(absl::string_view policy_file,
                                                             uint64_t seed) {
  ASSIGN_OR_RETURN(Policy policy, ParsePolicyFile(policy_file));
  ASSIGN_OR_RETURN(auto environment, MakeEnvironment(policy.environment));
  RETURN_IF_ERROR(CheckFits(policy, *environment));
  const auto served = Serve(std::move(policy));
  ASSIGN_OR_RETURN(SessionOptions options, ResolveSession({}, *served));
  return std::unique_ptr<Playground>(new Playground(
      served, std::move(environment), NewSession("playground", std::move(options)), seed));
}

Playground::Playground(std::shared_ptr<const ServedPolicy> served,
                       std::unique_ptr<Environment> environment, Session session, uint64_t seed)
    : served_(std::move(served)),
      environment_(std::move(environment)),
      agent_(served_, std::move(session), &clock_),
      seed_(seed) {
  state_.observation = environment_->Reset(seed_);
}

absl::StatusOr<nlohmann::json> Playground::Step() {
  if (state_.done()) {
    RETURN_IF_ERROR(BeginEpisode());
  }
  ASSIGN_OR_RETURN(const auto answer,
                   agent_.Act(/*step=*/std::nullopt, state_.observation, state_.reward));
  nlohmann::json decision = DecisionToJson(*served_, agent_.session());
  state_ = environment_->Step(answer->action);
  episode_return_ += state_.reward;
  AddEpisode(&decision);
  return decision;
}

absl::StatusOr<nlohmann::json> Playground::Explain() const {
  ASSIGN_OR_RETURN(const auto explanation,
                   spikeserve::Explain(served_->engine->CompletePolicy(), agent_.session()));
  nlohmann::json decision = DecisionToJson(*served_, agent_.session());
  AddTrace(explanation.trace, &decision);
  AddEpisode(&decision);
  return decision;
}

absl::Status Playground::BeginEpisode() {
  RETURN_IF_ERROR(
      agent_.EndEpisode({.reward = state_.reward, .terminated = state_.terminated}).status());
  state_ = {.observation = environment_->Reset(++seed_)};
  episode_return_ = 0.0;
  return absl::OkStatus();
}

void Playground::AddEpisode(nlohmann::json* decision) const {
  (*decision)["environment"] = std::string(environment_->id());
  (*decision)["seed"] = seed_;
  (*decision)["episode_return"] = episode_return_;
  (*decision)["ended"] = state_.done();
}

}  // namespace spikeserve
