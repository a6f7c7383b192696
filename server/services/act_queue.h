// Gathers the decisions that were requested in one turn of a loop and makes them together.
//
// A session belongs to one loop, by its id, so that its state stays in the caches of one core and
// its lock is rarely contended. A request that arrives at another loop is passed to its session's
// loop, and its answer is passed back.
//
// Confined to the thread of its loop; the queues of a server's loops exchange work by
// EventLoop::Post().
#ifndef SERVER_SERVICES_ACT_QUEUE_H_
#define SERVER_SERVICES_ACT_QUEUE_H_

#include <deque>
#include <memory>
#include <string>
#include <vector>

#include "absl/container/flat_hash_map.h"
#include "absl/status/status.h"
#include "absl/time/time.h"
#include "server/access/authenticator.h"
#include "server/agent/deferred_work.h"
#include "server/agent/policy_handler.h"
#include "server/agent/session_recovery.h"
#include "server/services/call_messages.h"
#include "server/transport/transport_loop.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

using ActMessages = CallMessages<v1::ActRequest, v1::ActResponse>;

// Receives the answers of a queue.
class ActClient {
 public:
  virtual ~ActClient() = default;
  // Called before OnDecided() if the request is granted and its answer waits for the store. Called
  // on the thread of the loop that the request came from.
  virtual void OnGranted() {}
  // Called on the thread of the loop that the request came from. `received` is the time that was
  // passed to Add().
  virtual void OnDecided(ActMessages& messages, const absl::Status& status, size_t request_bytes,
                         absl::Duration received) = 0;
};

// A call with many requests, of which the queue decides one group in a turn.
class ActBatchClient {
 public:
  virtual ~ActBatchClient() = default;
  // Decides the next group of at most kMaxSessionsPerGroup requests. Returns true if none is left.
  // Called on the thread of the loop that the call came from.
  virtual bool DecideGroup(const PolicyHandler& handler, DeferredWork* deferred) = 0;
};

class ActQueue {
 public:
  // One request. Keeps its client and its messages alive.
  struct Act {
    std::shared_ptr<ActClient> client;
    std::shared_ptr<ActMessages> messages;
    const Credential* caller;
    size_t request_bytes;
    absl::Duration received;  // of the server's clock
    bool recovered = false;   // the session was looked for in the store
    BeatProgress beats = {};  // as AgentAct::beats
  };

  // All must outlive the queue. If `recovery` is null, no session is stored.
  ActQueue(const PolicyHandler* handler, SessionRecovery* recovery, TransportLoop* loop)
      : handler_(*handler), recovery_(recovery), loop_(*loop) {}

  // Sets the queues of all loops, in the same order for each, before the loops run.
  void SetQueues(std::vector<ActQueue*> queues);

  // Adds a request, which is decided at the end of the turn.
  void Add(Act act);

  // Adds a call of many requests. Each turn decides one group of one such call, after everything
  // that Add() added; several such calls take turns.
  void AddBatch(std::shared_ptr<ActBatchClient> batch);

  // Decides what was added and passes on what belongs to other loops. The answers of each group are
  // written before the next group is decided; then what the answers need not wait for is done.
  void Run();

 private:
  // Requests from one loop.
  struct Batch {
    ActQueue* from;
    std::vector<Act> acts;
    std::vector<absl::Status> statuses;
    std::vector<Commits> commits;
  };

  // A request that came from the loop of `from`.
  struct Waiting {
    ActQueue* from;
    Act act;
  };

  void Decide(std::vector<Act> acts);
  void DecideBatchGroup();
  // Makes sure that Run() is called for what was added.
  void AskForTurn();
  void DecideForeign(const std::shared_ptr<Batch>& batch);
  // Lets a request wait for its turn, behind the others of its session.
  void Wait(ActQueue* from, Act act);
  // Lets those of `acts` wait whose session has a request that waits. Returns the others.
  std::vector<Act> HoldBack(ActQueue* from, std::vector<Act> acts);
  // Handles a part of the first request of one session that waits.
  void DecideWaiting();

  // Gives the answer to its client, or waits until the store has the session or the decision.
  void Answer(const Act& act, const absl::Status& status, const Commits& commits);
  void Recover(const Act& act, const absl::Status& status);

  const PolicyHandler& handler_;
  SessionRecovery* const recovery_;
  TransportLoop& loop_;
  std::vector<ActQueue*> queues_;
  std::vector<std::vector<Act>> added_;  // by the loop that the session belongs to
  std::vector<std::shared_ptr<Batch>> foreign_;
  std::deque<std::shared_ptr<ActBatchClient>> batches_;
  // Requests with many beats, of which each turn handles a part of one, and the requests behind
  // them, by session; and the sessions in the order of their turns.
  absl::flat_hash_map<std::string, std::deque<Waiting>> waiting_;
  std::deque<std::string> turns_;
  bool running_ = false;  // in Run(), and no further turn was asked for
};

}  // namespace spikeserve

#endif  // SERVER_SERVICES_ACT_QUEUE_H_
