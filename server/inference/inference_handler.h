// Answers the requests of the Open Inference Protocol v2 (KServe, Triton) through PolicyHandler: a
// model is a policy, a sequence is a session of one episode.
//
// A sequence lives at the server that has started it. Where several servers share sessions,
// requests of it may reach another one that still has an older sequence of the same id. Therefore
// the answer to the start has a token there, which the other requests must have.
//
// The session id is derived from tenant, model and sequence id, so no table of sequences is needed,
// and a sequence that is idle for the time-to-live is closed like any session. Requests carry no
// step, so a request that is sent twice counts as two timesteps.
//
// Thread-safe.
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "inference/grpc_service.pb.h"
#include "server/agent/call_context.h"
#include "server/agent/policy_handler.h"
#include "server/agent/session_gate.h"
#include "server/inference/inference_sequence.h"
#include "server/inference/inference_statistics.h"
#include "server/inference/inference_tensors.h"
#include "server/policies/policy_registry.h"

namespace spikeserve {

class InferenceHandler {
 public:
  // The pointers must outlive the handler. `session_ttl` is the time without a request after which
  // the store ends a sequence; it appears in ModelConfig and in messages. `has_joined` says whether
  // this server has taken over what it shares with others. `server` is its name among those that
  // share its sessions; empty: it is alone, and sequences have no token.
  InferenceHandler(PolicyRegistry* registry, const SessionGate* gate, const PolicyHandler* sessions,
                   const Clock* clock, absl::Duration session_ttl, std::function<bool()> has_joined,
                   std::string server)
      : registry_(registry),
        gate_(gate),
        sessions_(sessions),
        clock_(clock),
        session_ttl_(session_ttl),
        has_joined_(std::move(has_joined)),
        server_(std::move(server)) {}

  // Each method fills in `response` and returns OK. On an error it leaves all sequences unchanged,
  // except as ModelInfer describes.
  absl::Status ServerLive(CallContext& context, const inference::ServerLiveRequest& request,
                          inference::ServerLiveResponse* response) const;
  // Ready as the health of the services is: not while the server drains, nor before it has joined.
  absl::Status ServerReady(CallContext& context, const inference::ServerReadyRequest& request,
                           inference::ServerReadyResponse* response) const;
  absl::Status ModelReady(CallContext& context, const inference::ModelReadyRequest& request,
                          inference::ModelReadyResponse* response) const;
  absl::Status ServerMetadata(CallContext& context, const inference::ServerMetadataRequest& request,
                              inference::ServerMetadataResponse* response) const;
  absl::Status ModelMetadata(CallContext& context, const inference::ModelMetadataRequest& request,
                             inference::ModelMetadataResponse* response) const;
  absl::Status ModelConfig(CallContext& context, const inference::ModelConfigRequest& request,
                           inference::ModelConfigResponse* response) const;
  absl::Status ModelStatistics(CallContext& context,
                               const inference::ModelStatisticsRequest& request,
                               inference::ModelStatisticsResponse* response) const;
  absl::Status RepositoryIndex(CallContext& context,
                               const inference::RepositoryIndexRequest& request,
                               inference::RepositoryIndexResponse* response) const;
  // Loads all versions of a model. If some cannot be loaded, loads the others and returns the first
  // error. Returns NOT_FOUND if the policy directory has no version of the model.
  absl::Status RepositoryModelLoad(CallContext& context,
                                   const inference::RepositoryModelLoadRequest& request,
                                   inference::RepositoryModelLoadResponse* response) const;
  // Unloads all versions of a model. Returns FAILED_PRECONDITION and unloads none while a setting
  // of an operator uses one of them.
  absl::Status RepositoryModelUnload(CallContext& context,
                                     const inference::RepositoryModelUnloadRequest& request,
                                     inference::RepositoryModelUnloadResponse* response) const;

  // Makes one decision. sequence_start starts the sequence, and first ends a running sequence of
  // the same id, even if the request then fails. sequence_end ends the sequence after the decision,
  // which uses the observation and reward of the request. Returns INVALID_ARGUMENT without a
  // sequence id, and NOT_FOUND if the sequence does not run and the request does not start it.
  absl::Status ModelInfer(CallContext& context, const inference::ModelInferRequest& request,
                          inference::ModelInferResponse* response) const;

 private:
  // Returns a served version; an empty `version` means the default.
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> FindPolicy(const std::string& name,
                                                                 const std::string& version) const;
  // Returns the policy version that the running sequence of `request` was started on.
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> FindRunning(
      CallContext& context, const inference::ModelInferRequest& request,
      const SequenceRequest& sequence) const;
  // Returns the token of a sequence.
  std::string TokenOf(SessionEntry& entry) const;
  // Checks that the sequence here is the one that the request belongs to.
  absl::Status CheckToken(const SequenceRequest& sequence, SessionEntry& entry) const;
  absl::Status Start(CallContext& context, const inference::ModelInferRequest& request,
                     const SequenceRequest& sequence,
                     inference::ModelInferResponse* response) const;
  absl::Status Decide(CallContext& context, const inference::ModelInferRequest& request,
                      const InferenceInput& input, const SequenceRequest& sequence,
                      const ServedPolicy& served, v1::ActResponse* answer) const;
  absl::Status End(CallContext& context, const SequenceRequest& sequence) const;
  absl::Status Close(CallContext& context, const SequenceRequest& sequence) const;

  PolicyRegistry* const registry_;
  const SessionGate* const gate_;
  const PolicyHandler* const sessions_;
  const Clock* const clock_;
  const absl::Duration session_ttl_;
  const std::function<bool()> has_joined_;
  const std::string server_;  // empty: sequences have no token
  mutable InferenceStatistics statistics_;
};

}  // namespace spikeserve
