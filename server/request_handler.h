// Answers the requests of PolicyService. Knows messages and sessions, but no calls, streams or
// connections, so that everything an agent can ask is tested without a network.
//
// Thread-safe.
#ifndef SERVER_REQUEST_HANDLER_H_
#define SERVER_REQUEST_HANDLER_H_

#include <memory>
#include <string>
#include <vector>

#include "absl/container/inlined_vector.h"
#include "absl/status/status.h"
#include "core/session/session_store.h"
#include "server/policy_registry.h"
#include "server/shadow_runner.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// What is left to do once an answer has been sent: the action tokens of the sessions that decided,
// and what their shadows are to see.
class DeferredWork {
 public:
  // `shadows` must outlive this object.
  void Add(std::shared_ptr<SessionEntry> entry, ShadowRunner* shadows) {
    entries_.push_back(std::move(entry));
    shadows_ = shadows;
  }
  void Run();

 private:
  absl::InlinedVector<std::shared_ptr<SessionEntry>, 1> entries_;
  ShadowRunner* shadows_ = nullptr;
};

// Bounds on what one OpenSession can make the server keep or hash.
struct LabelLimits {
  static constexpr int kLabels = 32;
  static constexpr size_t kBytes = 256;  // of a key, a value or a routing key
};

class RequestHandler {
 public:
  // All must outlive the handler.
  RequestHandler(const PolicyRegistry* registry, SessionStore* store, ShadowRunner* shadows,
                 const Clock* clock);

  // Each fills in `response` and returns OK, or returns the error that api.md names and leaves the
  // session as it was.
  absl::Status ListPolicies(const v1::ListPoliciesRequest& request,
                            v1::ListPoliciesResponse* response) const;
  absl::Status OpenSession(const v1::OpenSessionRequest& request,
                           v1::OpenSessionResponse* response) const;
  absl::Status Act(const v1::ActRequest& request, v1::ActResponse* response,
                   DeferredWork* deferred) const;
  absl::Status ActBatch(const v1::ActBatchRequest& request, v1::ActBatchResponse* response,
                        DeferredWork* deferred) const;
  absl::Status EndEpisode(const v1::EndEpisodeRequest& request,
                          v1::EndEpisodeResponse* response) const;
  absl::Status GetSession(const v1::GetSessionRequest& request,
                          v1::GetSessionResponse* response) const;
  absl::Status CloseSession(const v1::CloseSessionRequest& request,
                            v1::CloseSessionResponse* response) const;

 private:
  const PolicyRegistry* const registry_;
  SessionStore* const store_;
  ShadowRunner* const shadows_;
  const Clock* const clock_;
};

}  // namespace spikeserve

#endif  // SERVER_REQUEST_HANDLER_H_
