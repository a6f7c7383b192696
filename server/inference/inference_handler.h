// Answers the requests of the Open Inference Protocol with what PolicyHandler does for
// PolicyService: a model is a policy, a sequence a session of one episode.
//
// The id of a sequence's session is made of the model and the sequence id, so there is no table to
// keep: a sequence that nobody used for the time-to-live is reaped like any session. Requests carry
// no step, so one that is sent again is a new timestep.
//
// Thread-safe.
#ifndef SERVER_INFERENCE_INFERENCE_HANDLER_H_
#define SERVER_INFERENCE_INFERENCE_HANDLER_H_

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/session/session_store.h"
#include "inference/grpc_service.pb.h"
#include "server/agent/policy_handler.h"
#include "server/inference/inference_sequence.h"
#include "server/inference/inference_statistics.h"
#include "server/inference/inference_tensors.h"
#include "server/policies/policy_registry.h"

namespace spikeserve {

class InferenceHandler {
 public:
  // All must outlive the handler. A sequence ends after `session_ttl` without a request.
  InferenceHandler(PolicyRegistry* registry, SessionStore* store, const PolicyHandler* sessions,
                   const Clock* clock, absl::Duration session_ttl)
      : registry_(registry),
        store_(store),
        sessions_(sessions),
        clock_(clock),
        session_ttl_(session_ttl) {}

  // Each fills in `response` and returns OK, or returns an error and leaves every sequence as it
  // was.
  absl::Status ServerLive(const inference::ServerLiveRequest& request,
                          inference::ServerLiveResponse* response) const;
  absl::Status ServerReady(const inference::ServerReadyRequest& request,
                           inference::ServerReadyResponse* response) const;
  absl::Status ModelReady(const inference::ModelReadyRequest& request,
                          inference::ModelReadyResponse* response) const;
  absl::Status ServerMetadata(const inference::ServerMetadataRequest& request,
                              inference::ServerMetadataResponse* response) const;
  absl::Status ModelMetadata(const inference::ModelMetadataRequest& request,
                             inference::ModelMetadataResponse* response) const;
  absl::Status ModelConfig(const inference::ModelConfigRequest& request,
                           inference::ModelConfigResponse* response) const;
  absl::Status ModelStatistics(const inference::ModelStatisticsRequest& request,
                               inference::ModelStatisticsResponse* response) const;
  absl::Status RepositoryIndex(const inference::RepositoryIndexRequest& request,
                               inference::RepositoryIndexResponse* response) const;
  // Where some versions cannot be read the others are, and the first error is returned. NOT_FOUND
  // for a model without a version in the policy directory.
  absl::Status RepositoryModelLoad(const inference::RepositoryModelLoadRequest& request,
                                   inference::RepositoryModelLoadResponse* response) const;
  // FAILED_PRECONDITION while an operator's setting points at one of its versions; then all stay.
  absl::Status RepositoryModelUnload(const inference::RepositoryModelUnloadRequest& request,
                                     inference::RepositoryModelUnloadResponse* response) const;

  // One decision. INVALID_ARGUMENT without a sequence id; NOT_FOUND for a sequence that does not
  // run, where the request does not start it. A start ends a sequence of the same id that still
  // runs, even if the request then fails. An end takes its observation and reward in, and ends the
  // sequence once the answer is made.
  absl::Status ModelInfer(const Credential& caller, const inference::ModelInferRequest& request,
                          inference::ModelInferResponse* response, DeferredWork* deferred);

 private:
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> FindPolicy(const std::string& name,
                                                                 const std::string& version) const;
  absl::StatusOr<std::shared_ptr<const ServedPolicy>> FindRunning(
      const Credential& caller, const inference::ModelInferRequest& request,
      const SequenceRequest& sequence) const;
  absl::Status Start(const Credential& caller, const inference::ModelInferRequest& request,
                     const SequenceRequest& sequence,
                     inference::ModelInferResponse* response) const;
  absl::Status Decide(const Credential& caller, const inference::ModelInferRequest& request,
                      const InferenceInput& input, const SequenceRequest& sequence,
                      const ServedPolicy& served, v1::ActResponse* answer,
                      DeferredWork* deferred) const;
  absl::Status End(const Credential& caller, const SequenceRequest& sequence) const;
  absl::Status Close(const Credential& caller, const SequenceRequest& sequence) const;

  PolicyRegistry* const registry_;
  SessionStore* const store_;
  const PolicyHandler* const sessions_;
  const Clock* const clock_;
  const absl::Duration session_ttl_;
  InferenceStatistics statistics_;
};

}  // namespace spikeserve

#endif  // SERVER_INFERENCE_INFERENCE_HANDLER_H_
