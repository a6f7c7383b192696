#include "server/inference/inference_handler.h"

#include <map>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/base/version.h"
#include "core/session/session_id.h"
#include "server/policies/policy_folder.h"

namespace spikeserve {
namespace {

using inference::ModelInferRequest;
using inference::ModelInferResponse;

constexpr char kPlatform[] = "spikeserve";

void FillConfig(const ServedPolicy& served, absl::Duration session_ttl,
                inference::ModelConfig* config) {
  config->set_name(served.name);
  config->set_platform(kPlatform);
  config->set_backend(kPlatform);
  config->mutable_version_policy()->mutable_all();
  for (const TensorSpec& spec : InputSpecs(served.policy())) {
    auto* input = config->add_input();
    input->set_name(spec.name);
    input->set_data_type(spec.data_type);
    input->mutable_dims()->Add(spec.shape.begin(), spec.shape.end());
    input->set_optional(spec.optional);
  }
  for (const TensorSpec& spec : OutputSpecs(served.policy())) {
    auto* output = config->add_output();
    output->set_name(spec.name);
    output->set_data_type(spec.data_type);
    output->mutable_dims()->Add(spec.shape.begin(), spec.shape.end());
  }
  if (const Features& features = served.policy().features; !features.empty()) {
    (*config->mutable_parameters())["features"].set_string_value(FormatFeatures(features));
  }
  auto* sequences = config->mutable_sequence_batching();
  sequences->mutable_direct();
  sequences->set_max_sequence_idle_microseconds(
      static_cast<uint64_t>(absl::ToInt64Microseconds(session_ttl)));
}

// Returns all served policy versions, ordered by name, then version.
std::vector<std::shared_ptr<const ServedPolicy>> ListServed(const PolicyRegistry& registry) {
  std::vector<std::shared_ptr<const ServedPolicy>> list;
  const auto catalog = registry.catalog();
  for (const auto& [name, policy] : catalog->policies()) {
    for (const auto& [version, served] : policy.versions) list.push_back(served);
  }
  return list;
}

absl::Status CheckRepository(const std::string& name) {
  if (name.empty()) return absl::OkStatus();
  return InvalidArgument("repository_name", "none, because there is one repository", Quoted(name));
}

void FillTensor(const TensorSpec& spec,
                inference::ModelMetadataResponse::TensorMetadata* metadata) {
  metadata->set_name(spec.name);
  metadata->set_datatype(DataTypeName(spec.data_type));
  metadata->mutable_shape()->Add(spec.shape.begin(), spec.shape.end());
}

}  // namespace

absl::StatusOr<std::shared_ptr<const ServedPolicy>> InferenceHandler::FindPolicy(
    const std::string& name, const std::string& version) const {
  ASSIGN_OR_RETURN(const auto number, ReadVersion(version));
  return registry_->catalog()->Find(name, number);
}

absl::Status InferenceHandler::ServerLive(CallContext& /*context*/,
                                          const inference::ServerLiveRequest& /*request*/,
                                          inference::ServerLiveResponse* response) const {
  response->set_live(true);
  return absl::OkStatus();
}

absl::Status InferenceHandler::ServerReady(CallContext& /*context*/,
                                           const inference::ServerReadyRequest& /*request*/,
                                           inference::ServerReadyResponse* response) const {
  response->set_ready(!gate_->store().draining() && has_joined_());
  return absl::OkStatus();
}

absl::Status InferenceHandler::ModelReady(CallContext& /*context*/,
                                          const inference::ModelReadyRequest& request,
                                          inference::ModelReadyResponse* response) const {
  response->set_ready(FindPolicy(request.name(), request.version()).ok());
  return absl::OkStatus();
}

absl::Status InferenceHandler::ServerMetadata(CallContext& /*context*/,
                                              const inference::ServerMetadataRequest& /*request*/,
                                              inference::ServerMetadataResponse* response) const {
  response->set_name(kPlatform);
  response->set_version(std::string(Version()));
  for (const char* extension : {"sequence", "sequence(string_id)", "model_repository",
                                "model_configuration", "statistics", "binary_tensor_data"}) {
    response->add_extensions(extension);
  }
  return absl::OkStatus();
}

absl::Status InferenceHandler::ModelMetadata(CallContext& /*context*/,
                                             const inference::ModelMetadataRequest& request,
                                             inference::ModelMetadataResponse* response) const {
  ASSIGN_OR_RETURN(const auto served, FindPolicy(request.name(), request.version()));
  response->set_name(request.name());
  for (const auto& other : ListServed(*registry_)) {
    if (other->name == request.name()) response->add_versions(absl::StrCat(other->version));
  }
  response->set_platform(kPlatform);
  for (const auto& spec : InputSpecs(served->policy())) FillTensor(spec, response->add_inputs());
  for (const auto& spec : OutputSpecs(served->policy())) {
    FillTensor(spec, response->add_outputs());
  }
  return absl::OkStatus();
}

absl::Status InferenceHandler::ModelConfig(CallContext& /*context*/,
                                           const inference::ModelConfigRequest& request,
                                           inference::ModelConfigResponse* response) const {
  ASSIGN_OR_RETURN(const auto served, FindPolicy(request.name(), request.version()));
  FillConfig(*served, session_ttl_, response->mutable_config());
  return absl::OkStatus();
}

absl::Status InferenceHandler::ModelStatistics(CallContext& /*context*/,
                                               const inference::ModelStatisticsRequest& request,
                                               inference::ModelStatisticsResponse* response) const {
  if (!request.name().empty()) {
    RETURN_IF_ERROR(FindPolicy(request.name(), request.version()).status());
  }
  for (const auto& served : ListServed(*registry_)) {
    if (!request.name().empty() && served->name != request.name()) continue;
    if (!request.version().empty() && absl::StrCat(served->version) != request.version()) continue;
    *response->add_model_stats() = statistics_.Get(served->name, served->version);
  }
  return absl::OkStatus();
}

absl::Status InferenceHandler::RepositoryIndex(CallContext& /*context*/,
                                               const inference::RepositoryIndexRequest& request,
                                               inference::RepositoryIndexResponse* response) const {
  RETURN_IF_ERROR(CheckRepository(request.repository_name()));
  ASSIGN_OR_RETURN(const auto folders, registry_->folder().List());
  std::map<PolicyVersion, bool> ready;
  for (const PolicyVersion& version : folders.versions) ready[version] = false;
  for (const auto& served : ListServed(*registry_)) {
    ready[{served->name, served->version}] = true;
  }
  for (const auto& [version, is_ready] : ready) {
    if (request.ready() && !is_ready) continue;
    auto* model = response->add_models();
    model->set_name(version.policy);
    model->set_version(absl::StrCat(version.version));
    model->set_state(is_ready ? "READY" : "UNAVAILABLE");
    if (!is_ready) model->set_reason("not loaded");
  }
  return absl::OkStatus();
}

absl::Status InferenceHandler::RepositoryModelLoad(
    CallContext& context, const inference::RepositoryModelLoadRequest& request,
    inference::RepositoryModelLoadResponse* /*response*/) const {
  RETURN_IF_ERROR(CheckRepository(request.repository_name()));
  if (!request.parameters().empty()) {
    return InvalidArgument("parameters", "none, because a model is defined by its file",
                           Quoted(request.parameters().begin()->first));
  }
  ASSIGN_OR_RETURN(const auto folders, registry_->folder().List());
  absl::Status status = absl::NotFoundError(
      absl::StrCat("model_name: expected a policy in the policy directory, received ",
                   Quoted(request.model_name())));
  bool found = false;
  // The highest version first: it becomes the default of a policy that was not served.
  for (auto it = folders.versions.rbegin(); it != folders.versions.rend(); ++it) {
    const PolicyVersion& version = *it;
    if (version.policy != request.model_name()) continue;
    if (!std::exchange(found, true)) status = absl::OkStatus();
    status.Update(registry_->LoadVersion(version, /*make_default=*/false, &context.span).status());
  }
  return status;
}

absl::Status InferenceHandler::RepositoryModelUnload(
    CallContext& /*context*/, const inference::RepositoryModelUnloadRequest& request,
    inference::RepositoryModelUnloadResponse* /*response*/) const {
  RETURN_IF_ERROR(CheckRepository(request.repository_name()));
  const auto catalog = registry_->catalog();
  ASSIGN_OR_RETURN(const auto policy, catalog->FindPolicy(request.model_name()));
  for (const auto& [version, served] : policy->versions) {
    const std::string use = policy->settings.DescribeUseBesideDefault(version);
    if (!use.empty()) {
      return absl::FailedPreconditionError(
          absl::StrCat("model_name: expected a policy without a version that a setting uses, "
                       "received one whose version ",
                       version, " is ", use));
    }
  }
  // The default last: it can be unloaded once it is the only version.
  const int64_t last = policy->DefaultVersion();
  for (const auto& [version, served] : policy->versions) {
    if (version == last) continue;
    RETURN_IF_ERROR(registry_->Unload({.policy = request.model_name(), .version = version}));
  }
  return registry_->Unload({.policy = request.model_name(), .version = last});
}

absl::Status InferenceHandler::ModelInfer(CallContext& context, const ModelInferRequest& request,
                                          ModelInferResponse* response) const {
  const absl::Duration start = clock_->Now();
  ASSIGN_OR_RETURN(auto sequence, ReadSequence(request));
  // The tenant is part of the session id, so that tenants may use equal sequence ids.
  if (const std::string& tenant = context.caller->tenant()->name(); !tenant.empty()) {
    sequence.session_id = absl::StrCat(tenant, "/", sequence.session_id);
  }
  ASSIGN_OR_RETURN(const auto input, ReadInputs(request));
  if (sequence.start) {
    RETURN_IF_ERROR(Start(context, request, sequence, response));
  }
  ASSIGN_OR_RETURN(const auto served, FindRunning(context, request, sequence));
  const std::string& name = served->name;
  const int64_t version = served->version;

  v1::ActResponse answer;
  if (auto status = Decide(context, request, input, sequence, *served, &answer); !status.ok()) {
    if (sequence.start) status.Update(Close(context, sequence));
    statistics_.CountFailure(name, version, clock_->Now() - start);
    return status;
  }
  response->set_model_name(name);
  response->set_model_version(absl::StrCat(version));
  response->set_id(request.id());
  WriteOutputs(answer, request, input, response);
  if (answer.has_hold()) {
    (*response->mutable_parameters())["hold"].set_string_param(answer.hold().id());
  }
  if (answer.has_wiring()) {
    (*response->mutable_parameters())["wiring"].set_string_param(answer.wiring().text());
  }
  statistics_.CountSuccess(name, version, absl::Now(), clock_->Now() - start,
                           absl::Seconds(answer.stats().compute_seconds()));
  return sequence.end ? End(context, sequence) : absl::OkStatus();
}

absl::Status InferenceHandler::Start(CallContext& context, const ModelInferRequest& request,
                                     const SequenceRequest& sequence,
                                     ModelInferResponse* response) const {
  ASSIGN_OR_RETURN(const auto opening, ReadOpening(request));
  // Closes a sequence of the same id that still runs: its agent has started anew.
  if (auto status = Close(context, sequence); !status.ok() && !absl::IsNotFound(status))
    return status;
  v1::OpenSessionResponse opened;
  RETURN_IF_ERROR(sessions_->OpenSessionAs(context, sequence.session_id, opening, &opened));
  if (!opened.recording().empty()) {
    (*response->mutable_parameters())["recording"].set_string_param(opened.recording());
  }
  if (server_.empty()) return absl::OkStatus();
  ASSIGN_OR_RETURN(const auto entry, gate_->Find(context, sequence.session_id));
  (*response->mutable_parameters())[kSequenceToken].set_string_param(TokenOf(*entry));
  return absl::OkStatus();
}

// No other sequence of the same id has it: neither one of another server, nor one before this one.
std::string InferenceHandler::TokenOf(SessionEntry& entry) const {
  absl::MutexLock lock(&entry.mutex);
  return absl::StrCat(server_, "-", absl::ToInt64Nanoseconds(entry.agent.created()));
}

absl::Status InferenceHandler::CheckToken(const SequenceRequest& sequence,
                                          SessionEntry& entry) const {
  if (server_.empty() || sequence.start || sequence.token == TokenOf(entry)) {
    return absl::OkStatus();
  }
  if (!sequence.token.empty()) return NoSuchSession(sequence.session_id);
  return absl::FailedPreconditionError(
      absl::StrCat("parameters.", kSequenceToken,
                   ": expected the parameter of the answer to sequence_start, because several "
                   "servers may have a sequence of this id, received none"));
}

absl::StatusOr<std::shared_ptr<const ServedPolicy>> InferenceHandler::FindRunning(
    CallContext& context, const ModelInferRequest& request, const SequenceRequest& sequence) const {
  ASSIGN_OR_RETURN(const auto version, ReadVersion(request.model_version()));
  const auto entry = gate_->Find(context, sequence.session_id);
  const absl::Status known = entry.ok() ? CheckToken(sequence, **entry) : entry.status();
  if (absl::IsFailedPrecondition(known)) return known;
  if (!known.ok() || (*entry)->served->name != request.model_name()) {
    return absl::NotFoundError(absl::StrCat(
        "parameters.sequence_id: expected a running sequence of model ",
        Quoted(request.model_name()), ", received ", Quoted(sequence.id),
        "; send sequence_start with the first request. A sequence without a request for ",
        absl::FormatDuration(session_ttl_), " is ended"));
  }
  const auto& served = (*entry)->served;
  if (version == 0 || version == served->version) return served;
  return InvalidArgument(
      "model_version",
      absl::StrCat("none, or ", served->version, ", which the sequence was started on"), version);
}

absl::Status InferenceHandler::Decide(CallContext& context, const ModelInferRequest& request,
                                      const InferenceInput& input, const SequenceRequest& sequence,
                                      const ServedPolicy& served, v1::ActResponse* answer) const {
  RETURN_IF_ERROR(CheckOutputs(request, OutputSpecs(served.policy())));
  if (!sequence.start && !input.reward.has_value()) {
    return InvalidArgument(
        "inputs", "reward, for the previous action, in every request after the first of a sequence",
        "none");
  }
  v1::ActRequest act;
  act.set_session_id(sequence.session_id);
  act.mutable_observation()->Add(input.observation.begin(), input.observation.end());
  act.set_reward(static_cast<double>(input.reward.value_or(0.0f)));
  return sessions_->Act(context, act, answer, /*is_next=*/true);
}

absl::Status InferenceHandler::End(CallContext& context, const SequenceRequest& sequence) const {
  // The action of the last decision is not carried out, so a recording ends with the observation of
  // that decision.
  const bool terminated = !sequence.truncated || sequence.terminated;
  if (const auto entry = gate_->Find(context, sequence.session_id); entry.ok()) {
    absl::MutexLock lock(&(*entry)->mutex);
    if ((*entry)->recorder != nullptr) (*entry)->recorder->CutOff(terminated);
  }
  v1::EndEpisodeRequest end;
  end.set_session_id(sequence.session_id);
  end.set_terminated(terminated);
  end.set_truncated(sequence.truncated);
  v1::EndEpisodeResponse ended;
  RETURN_IF_ERROR(sessions_->EndEpisode(context, end, &ended));
  return Close(context, sequence);
}

absl::Status InferenceHandler::Close(CallContext& context, const SequenceRequest& sequence) const {
  v1::CloseSessionRequest close;
  close.set_session_id(sequence.session_id);
  v1::CloseSessionResponse closed;
  return sessions_->CloseSession(context, close, &closed);
}

}  // namespace spikeserve
