// Answers the requests of PolicyService. Knows messages and sessions, but no calls, streams or
// connections, so that everything an agent can ask is tested without a network.
//
// Thread-safe.
#ifndef SERVER_AGENT_POLICY_HANDLER_H_
#define SERVER_AGENT_POLICY_HANDLER_H_

#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "core/session/session_store.h"
#include "server/access/authenticator.h"
#include "server/agent/deferred_work.h"
#include "server/agent/recordings.h"
#include "server/agent/shadow_runner.h"
#include "server/policies/policy_registry.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Bounds on what one OpenSession can make the server keep or hash.
struct LabelLimits {
  static constexpr int kLabels = 32;
  static constexpr size_t kBytes = 256;  // of a key, a value or a routing key
};

class PolicyHandler {
 public:
  // All must outlive the handler. Without `recordings` no session is recorded.
  PolicyHandler(const PolicyRegistry* registry, SessionStore* store, ShadowRunner* shadows,
                const Clock* clock, Recordings* recordings = nullptr);

  // A session belongs to the tenant that opened it and is NOT_FOUND for every other caller, but for
  // those who may see it, in the calls that only look: GetSession and Explain, which do not count
  // as a use of it.
  //
  // Each fills in `response` and returns OK, or returns the error that api.md names and leaves the
  // session as it was.
  absl::Status ListPolicies(const v1::ListPoliciesRequest& request,
                            v1::ListPoliciesResponse* response) const;
  absl::Status OpenSession(const Credential& caller, const v1::OpenSessionRequest& request,
                           v1::OpenSessionResponse* response) const;
  // Under an id that the caller picks; ALREADY_EXISTS where it is taken.
  absl::Status OpenSessionAs(const Credential& caller, std::string id,
                             const v1::OpenSessionRequest& request,
                             v1::OpenSessionResponse* response) const;
  absl::Status Act(const Credential& caller, const v1::ActRequest& request,
                   v1::ActResponse* response, DeferredWork* deferred) const;
  // At the step that the session expects, whatever `request` says, so nothing is ever a retry.
  absl::Status ActNext(const Credential& caller, const v1::ActRequest& request,
                       v1::ActResponse* response, DeferredWork* deferred) const;
  // Answers item by item; an item that fails has its own code in `response`.
  absl::Status ActBatch(const Credential& caller, const v1::ActBatchRequest& request,
                        v1::ActBatchResponse* response, DeferredWork* deferred) const;
  absl::Status EndEpisode(const Credential& caller, const v1::EndEpisodeRequest& request,
                          v1::EndEpisodeResponse* response) const;
  absl::Status GetSession(const Credential& caller, const v1::GetSessionRequest& request,
                          v1::GetSessionResponse* response) const;
  // Takes long; holds the session's lock for a moment only.
  absl::Status Explain(const Credential& caller, const v1::ExplainRequest& request,
                       v1::ExplainResponse* response) const;
  absl::Status CloseSession(const Credential& caller, const v1::CloseSessionRequest& request,
                            v1::CloseSessionResponse* response) const;

 private:
  // A session that `caller` may see, not marked as used.
  absl::StatusOr<std::shared_ptr<SessionEntry>> Look(const Credential& caller,
                                                     const std::string& id) const;

  // Records a session of `served` under a new `name`.
  absl::StatusOr<std::unique_ptr<EpisodeRecorder>> NewRecorder(
      const std::shared_ptr<const ServedPolicy>& served, std::string* name) const;

  // The session that `request` may decide for now, within its tenant's limits.
  absl::StatusOr<std::shared_ptr<SessionEntry>> FindForDecision(
      const Credential& caller, const v1::ActRequest& request) const;
  // At the step that the session expects where `step` is nothing.
  absl::Status ActAt(const Credential& caller, std::optional<int64_t> step,
                     const v1::ActRequest& request, v1::ActResponse* response,
                     DeferredWork* deferred) const;

  const PolicyRegistry* const registry_;
  SessionStore* const store_;
  ShadowRunner* const shadows_;
  const Clock* const clock_;
  Recordings* const recordings_;
};

}  // namespace spikeserve

#endif  // SERVER_AGENT_POLICY_HANDLER_H_
