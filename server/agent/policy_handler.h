// Answers the requests of PolicyService. Works on messages and sessions, independent of calls,
// streams and connections, so that it can be tested without a network.
//
// Thread-safe.
#pragma once

#include <memory>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "absl/types/span.h"
#include "core/agent/episode_recorder.h"
#include "core/journal/journal_writer.h"
#include "core/open_sessions/session_store.h"
#include "server/access/authenticator.h"
#include "server/agent/call_context.h"
#include "server/agent/datagram_channels.h"
#include "server/agent/decision_request.h"
#include "server/agent/session_gate.h"
#include "server/agent/session_recovery.h"
#include "server/followers/recordings.h"
#include "server/followers/shadow_runner.h"
#include "server/policies/policy_registry.h"
#include "server/policies/shared_files.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// The largest number of requests in one ActBatch.
inline constexpr int kMaxBatch = 1024;

// How sessions are stored.
struct SessionDurability {
  JournalWriter* journals = nullptr;      // null: no session is stored
  Durability level = Durability::kAsync;  // of sessions that ask for none and do not learn
  const SharedFiles* files = nullptr;     // null: no other server continues with them
};

class PolicyHandler {
 public:
  // All arguments must outlive the handler. If `recordings` is null, sessions cannot be recorded;
  // if `datagrams` is, they get no channel for datagrams.
  PolicyHandler(const PolicyRegistry* registry, const SessionGate* gate, ShadowRunner* shadows,
                const Clock* clock, Recordings* recordings = nullptr,
                SessionDurability durability = {}, DatagramChannels* datagrams = nullptr)
      : registry_(registry),
        gate_(gate),
        store_(&gate->store()),
        shadows_(shadows),
        clock_(clock),
        recordings_(recordings),
        durability_(durability),
        datagrams_(datagrams) {}

  // A session belongs to the tenant that opened it; callers of other tenants receive NOT_FOUND. The
  // exceptions are GetSession and Explain, which also serve callers that may read the session
  // (Credential::CanRead). Both leave the idle time of the session unchanged.
  //
  // Each method fills in `response` and returns OK. On an error it leaves the session unchanged and
  // returns the status that policy_service.proto names.
  absl::Status ListPolicies(CallContext& context, const v1::ListPoliciesRequest& request,
                            v1::ListPoliciesResponse* response) const;
  absl::Status OpenSession(CallContext& context, const v1::OpenSessionRequest& request,
                           v1::OpenSessionResponse* response) const;
  // As OpenSession, with an id of any form that the caller chooses; an empty id gets a new random
  // one. The session is not stored. Returns ALREADY_EXISTS if a session with this id is open.
  absl::Status OpenSessionAs(CallContext& context, std::string id,
                             const v1::OpenSessionRequest& request,
                             v1::OpenSessionResponse* response) const;
  // If `is_next`, ignores request.step and decides at the step that the session expects, so that
  // the request is never a retry.
  absl::Status Act(CallContext& context, const v1::ActRequest& request, v1::ActResponse* response,
                   bool is_next = false) const;
  // Decides the first requests of `acts` together, as Act does each, and returns how many: at most
  // kMaxSessionsPerGroup, and at most one of a session. Those behind it for the same session come
  // after it: a request with many beats may be left unfinished, and one whose session is to be
  // taken over waits for that. `budget` bounds the beats. REQUIRES: `acts` is not empty.
  size_t ActGroup(absl::Span<DecisionRequest* const> acts, DeferredWork* deferred,
                  StepBudget* budget) const;
  // Returns the budget of one turn that begins now.
  StepBudget NewBudget() const;
  // Takes over the session of a request that waits for that, as SessionGate::Claim does.
  void Claim(const DecisionRequest& act, const SessionRecovery::Post& post,
             SessionRecovery::Done done) const {
    gate_->Claim(*act.context, act.request->session_id(), post, std::move(done));
  }
  // Returns INVALID_ARGUMENT if a batch has more than kMaxBatch requests.
  static absl::Status CheckBatch(const v1::ActBatchRequest& request);
  // Answers at most kMaxSessionsPerGroup items of a batch, from `first` on, and returns the index
  // after the last one. `response` gets a result for each item of the batch; one that is answered
  // there already stays. An item that fails has its own code. An item with past beats is a group of
  // its own. If it has not finished, returns `first`, and the next call goes on with it, by
  // `progress`. REQUIRES: CheckBatch returned OK.
  int ActBatchGroup(CallContext& context, const v1::ActBatchRequest& request, int first,
                    v1::ActBatchResponse* response, absl::Duration received, StepOutcome* progress,
                    StepBudget* budget = nullptr) const;
  absl::Status EndEpisode(CallContext& context, const v1::EndEpisodeRequest& request,
                          v1::EndEpisodeResponse* response) const;
  // May wait for the disk.
  absl::Status AmendEpisode(CallContext& context, const v1::AmendEpisodeRequest& request,
                            v1::AmendEpisodeResponse* response) const;
  absl::Status GetSession(CallContext& context, const v1::GetSessionRequest& request,
                          v1::GetSessionResponse* response) const;
  // Takes about a thousand times as long as a decision; see ExplainSession.
  absl::Status Explain(CallContext& context, const v1::ExplainRequest& request,
                       v1::ExplainResponse* response) const;
  absl::Status ExportSession(CallContext& context, const v1::ExportSessionRequest& request,
                             v1::ExportSessionResponse* response) const;
  absl::Status CloseSession(CallContext& context, const v1::CloseSessionRequest& request,
                            v1::CloseSessionResponse* response) const;

 private:
  // Returns the durability of a new session: INVALID_ARGUMENT if the server cannot give it,
  // PERMISSION_DENIED if it is above the ceiling of the tenant.
  absl::StatusOr<Durability> ChooseDurability(const Tenant& tenant,
                                              const v1::OpenSessionRequest& request) const;
  // Returns the settings of a session that `request` opens.
  absl::StatusOr<SessionOptions> OptionsOf(const v1::OpenSessionRequest& request,
                                           const ServedPolicy& served) const;
  // Opens a session that does not exist yet.
  absl::Status OpenNew(CallContext& context, std::string id, const v1::OpenSessionRequest& request,
                       Durability durability, v1::OpenSessionResponse* response) const;
  // Answers a request for a session that is open. Returns ALREADY_EXISTS unless the same request
  // opened it.
  absl::Status OpenAgain(CallContext& context, SessionEntry& entry,
                         const v1::OpenSessionRequest& request, Durability durability,
                         v1::OpenSessionResponse* response) const;
  // Returns a recorder for a session of `served`, and sets `name` to a new name for the recording.
  absl::StatusOr<std::unique_ptr<EpisodeRecorder>> NewRecorder(
      const std::shared_ptr<const ServedPolicy>& served, const std::string& tenant,
      std::string* name) const;

  // Checks that a caller who may not learn does not play a session that does, which another token
  // has opened.
  static absl::Status CheckMayPlay(const Credential& caller, SessionEntry& entry);

  // Gives an open session the verdict, and its recording a line.
  absl::Status AmendSession(CallContext& context, const Amendment& amendment,
                            const EpisodeAmendment& line, SessionEntry& entry,
                            v1::AmendEpisodeResponse* response) const;

  // Returns a session that the caller may read, without resetting its idle time: of this server, or
  // CallContext::read.
  absl::StatusOr<std::shared_ptr<SessionEntry>> FindReadable(const CallContext& context,
                                                             const std::string& id) const;

  // Counts the beats that were appended as decisions of the caller's tenant, as far as its limit
  // goes.
  void CountBeats(const Credential& caller, int64_t beats) const;
  // Counts one decision of the caller's tenant and returns the session of `request`. Returns
  // RESOURCE_EXHAUSTED if the tenant exceeds its limit.
  absl::StatusOr<std::shared_ptr<SessionEntry>> FindForDecision(
      CallContext& context, const v1::ActRequest& request) const;

  const PolicyRegistry* const registry_;
  const SessionGate* const gate_;
  SessionStore* const store_;  // of the gate
  ShadowRunner* const shadows_;
  const Clock* const clock_;
  Recordings* const recordings_;
  const SessionDurability durability_;
  DatagramChannels* const datagrams_;  // null: the server offers none
  // The answer to ListPolicies is made once for each catalog: reading the training records of a
  // thousand versions takes milliseconds.
  mutable absl::Mutex list_mutex_;
  mutable std::weak_ptr<const PolicyCatalog> listed_ ABSL_GUARDED_BY(list_mutex_);
  mutable v1::ListPoliciesResponse list_ ABSL_GUARDED_BY(list_mutex_);  // of `listed_`
};

}  // namespace spikeserve
