// Leads the requests of sessions through one gate. On the way in, a handler finds the session. On
// the way out, holds an answer until the store has persisted what it acknowledges. If the session
// is unknown here, claims it from the store and retries the request once. Decisions wait for that
// in the queue of their session (act_queue.h), in order. Sends NOT_FOUND only if the store has said
// so.
//
//   gate.Enter(&request.call_context());
//   gate.Leave(request, handler.EndEpisode(request.call_context(), ...));  // calls Answer()
//
// Thread-safe. Leave() and the functions of one GatedRequest run on the thread of its loop.
#pragma once

#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/agent/head_log.h"
#include "core/agent/step.h"
#include "core/open_sessions/session_store.h"
#include "server/agent/call_context.h"
#include "server/agent/session_recovery.h"

namespace spikeserve {

// A request whose answer leaves by the gate: a call, or a message of a stream.
class GatedRequest {
 public:
  virtual ~GatedRequest() = default;

  CallContext& call_context() { return call_context_; }

  // Returns what keeps the request alive.
  virtual std::shared_ptr<GatedRequest> Self() = 0;
  // Returns a function that runs work on the thread of the request's loop, also after the call is
  // over.
  virtual SessionRecovery::Post post() = 0;
  // Returns true if nobody waits for the answer, so that nothing is taken over or awaited for it.
  virtual bool is_over() = 0;

  // Returns the sessions that `status`, or the response, says are not here.
  virtual std::vector<std::string> MissingSessions(const absl::Status& /*status*/) { return {}; }
  // Returns true for a batch: its items fail alone.
  virtual bool has_items() const { return false; }
  // Handles the request from its start, or those of its items that found no session. `unclaimed`
  // tells why sessions could not be taken over; it is empty unless the request has items. A request
  // that only reads has CallContext::read now.
  virtual void HandleAgain(const std::map<std::string, absl::Status>& /*unclaimed*/) {}

  // Returns true if the request only reads its session, which then stays with its owner.
  virtual bool only_reads() const { return false; }

  // The request is granted, and its answer waits for the store.
  virtual void OnGranted() {}
  // Replaces the result of an item by an error.
  virtual void FailItem(int /*item*/, const absl::Status& /*status*/) {}
  // Completes the response with the outcome of a contribution to the head of a fleet.
  virtual void TakeMerged(const FleetContribution& /*contribution*/) {}
  // Sends the response, or the error.
  virtual void Answer(const absl::Status& status) = 0;

 private:
  CallContext call_context_;
};

// What an answer about a session waits for.
enum class Await {
  kDurable,    // what the durability of the session says
  kStored,     // also all that was written, whatever the durability is
  kOwned,      // as kStored if other servers use the store, which so says whose the session is
  kConfirmed,  // as kOwned, with a query, because the request has written nothing
};

// Returns what fits a request at `place`: one that does not name its decision may be for another
// copy of the session.
inline Await AwaitAt(const Place& place, bool has_written) {
  if (place.is_of_session()) return Await::kDurable;
  return has_written ? Await::kOwned : Await::kConfirmed;
}

// Adds what the answer must wait for, under the session's lock, so that it waits for what it tells.
// An operator is heard only in what the store has: the next owner of the session would go on with
// the operator before, who was relieved.
void AddCommit(const SessionEntry& entry, Await await, Commits* commits)
    ABSL_SHARED_LOCKS_REQUIRED(entry.mutex);

// Returns UNAVAILABLE if an operator has control whom no answer may tell of, because the store
// cannot be reached. The lease ends by itself.
absl::Status CheckMayBeHeard(const SessionEntry& entry) ABSL_SHARED_LOCKS_REQUIRED(entry.mutex);

class SessionGate {
 public:
  // Both must outlive the gate. If `recovery` is null, no session is stored.
  explicit SessionGate(SessionStore* store, SessionRecovery* recovery = nullptr)
      : store_(*store), recovery_(recovery) {}

  SessionStore& store() const { return store_; }

  // To be called before a request is handled for the first time.
  void Enter(CallContext* context) const;

  // Returns an open session of the caller's tenant, and counts it as used. NOT_FOUND: it is not
  // here.
  absl::StatusOr<std::shared_ptr<SessionEntry>> Find(const CallContext& context,
                                                     const std::string& id) const;

  // Takes session `id` over for a request with `context`, which outlives that. Calls `done` by
  // `post`, or at once, as SessionRecovery does. DecisionRequest::OnClaimed() is to be called for
  // every request that has waited.
  void Claim(const CallContext& context, const std::string& id, const SessionRecovery::Post& post,
             SessionRecovery::Done done) const;
  // Lets the error of a request that was not decided wait for what the answers before it wait for.
  void AwaitEarlier(const std::string& id, CallContext* context) const;
  // Returns the error for a session that was taken over and is not here any more.
  static absl::Status MovedError();

  // Returns the error for a request at `place` that the session has refused with the
  // FAILED_PRECONDITION `refusal`: what the session expects, if `refusal` is no conflict, or, if
  // this copy of it may be an old one and may be claimed, NOT_FOUND. The copy is lost then.
  static absl::Status Refused(const CallContext& context, const Place& place,
                              const absl::Status& refusal, SessionEntry& entry)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);

  // Traces what was written to the journal of the session, and `contribution`, if no answer waits
  // for them: a span "append" of `call` ends when the store has the record, and a span "merge" when
  // the head of the fleet has the contribution. A record that is traced does not gather with others
  // before it is written. Does nothing if `call` is empty or the session is not stored.
  static void Trace(const Span& call, const SessionEntry& entry,
                    const std::shared_ptr<FleetContribution>& contribution = nullptr)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);

  // Begins the span of a merge into the head of a fleet that the end of an episode itself does,
  // because the session is not stored; empty for other sessions.
  static Span StartMerge(const Span& call, const SessionEntry& entry)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex);

  // Sends the answer of a request whose handler has returned `status`, now or later.
  void Leave(GatedRequest& request, const absl::Status& status) const;

 private:
  // Of one request, for the sessions that are not here.
  struct Search;

  // Returns true if the request is handled again when the store has answered.
  bool FindMissing(GatedRequest& request, const absl::Status& status) const;
  static void OnRead(Search& search, absl::StatusOr<std::shared_ptr<SessionEntry>> session);
  static void OnFound(Search& search, const std::string& id, const absl::Status& claimed);
  void Await(GatedRequest& request, const absl::Status& status) const;
  // Removes a session that the store has refused to open. Returns false if the store has it.
  bool Withdraw(SessionJournal& journal) const;
  void OnDurable(GatedRequest& request, const absl::Status& status,
                 const std::vector<absl::Status>& outcomes) const;

  SessionStore& store_;
  SessionRecovery* const recovery_;
};

}  // namespace spikeserve
