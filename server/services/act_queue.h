// Gathers the decisions that were requested in one turn of a loop and makes them together.
//
// A session belongs to one loop, by its id, so that its state stays in the caches of one core and
// its lock is rarely contended. A request that arrives at another loop is passed to its session's
// loop, and its answer is passed back.
//
// Confined to the thread of its loop; the queues of a server's loops exchange work by
// EventLoop::Post().
#pragma once

#include <deque>
#include <memory>
#include <string>
#include <vector>

#include "absl/types/span.h"
#include "server/agent/policy_handler.h"
#include "server/agent/session_gate.h"
#include "server/services/call_messages.h"
#include "server/services/service_context.h"
#include "server/transport/transport_loop.h"

namespace spikeserve {

class ActQueue;

// One request for a decision, from its arrival to its answer, however it came: as a call, in a
// stream or as a datagram. Enters the queue of its loop, is decided, leaves by the gate, and sends
// the answer. Keeps its messages in its own memory.
class QueuedAct : public GatedRequest, public std::enable_shared_from_this<QueuedAct> {
 public:
  // Received now. Both must outlive the request.
  QueuedAct(const ServiceContext* context, ActQueue* queue);

  v1::ActRequest* request() { return static_cast<v1::ActRequest*>(messages_.request()); }
  v1::ActResponse* response() { return static_cast<v1::ActResponse*>(messages_.response()); }
  DecisionRequest& act() { return act_; }
  // Bytes that a request occupies, beside what is too long for its memory.
  static constexpr size_t kBytes = sizeof(CallMessages);

  // Lets the queue decide the request of `caller`.
  void Enter(const Credential* caller);
  // The request is decided. Called on the thread of the loop that it came from.
  void Leave() { context_.sessions->Leave(*this, act_.status); }

  // Sends the answer, whether it is decided or refused on its arrival.
  void Answer(const absl::Status& status) final {
    act_.Become(DecisionState::kAnswered);
    Send(status);
  }
  std::shared_ptr<GatedRequest> Self() final { return shared_from_this(); }
  SessionRecovery::Post post() final;
  // A decision is made and stored whether its caller waits for it or not.
  bool is_over() final { return false; }

 protected:
  // Sends the response, or the error.
  virtual void Send(const absl::Status& status) = 0;

 private:
  const ServiceContext& context_;
  ActQueue& queue_;
  CallMessages messages_ = {v1::ActRequest::default_instance(),
                            v1::ActResponse::default_instance()};
  DecisionRequest act_;
};

// A call with many requests, of which the queue decides one group in a turn.
class QueuedBatch {
 public:
  virtual ~QueuedBatch() = default;
  // Decides the next group of at most kMaxSessionsPerGroup requests. Returns true if none is left.
  // Called on the thread of the loop that the call came from. `budget` is that of the turn.
  virtual bool DecideGroup(const PolicyHandler& handler, DeferredWork* deferred,
                           StepBudget* budget) = 0;
};

class ActQueue {
 public:
  // Both must outlive the queue.
  ActQueue(const PolicyHandler* handler, TransportLoop* loop) : handler_(*handler), loop_(*loop) {}

  // Sets the queues of all loops, in the same order for each, before the loops run.
  void SetQueues(std::vector<ActQueue*> queues);

  EventLoop& events() const { return loop_.events(); }

  // Adds a request, which is decided at the end of the turn.
  void Add(std::shared_ptr<QueuedAct> act);

  // Adds a call of many requests. Each turn decides one group of one such call, after everything
  // that Add() added; several such calls take turns.
  void AddBatch(std::shared_ptr<QueuedBatch> batch);

  // Decides what was added and passes on what belongs to other loops. The answers of each group are
  // written before the next group is decided; then what the answers need not wait for is done.
  void Run();

 private:
  // The requests keep their calls alive.
  using Acts = std::vector<std::shared_ptr<QueuedAct>>;
  // Requests from one loop.
  struct Foreign {
    ActQueue* from;
    Acts acts;
  };

  // A request that came from the loop of `from`.
  struct Waiting {
    ActQueue* from;
    std::shared_ptr<QueuedAct> act;
  };

  // Removes the next group from `acts`, which came from the loop of `from`, and returns those that
  // are decided. The others wait, and those behind them for their sessions.
  Acts DecideGroup(ActQueue* from, absl::Span<std::shared_ptr<QueuedAct>>* acts,
                   DeferredWork* deferred, StepBudget* budget);
  void Decide(Acts acts, StepBudget* budget);
  void DecideBatchGroup(StepBudget* budget);
  void DecideForeign(const std::shared_ptr<Foreign>& foreign, StepBudget* budget);
  // Lets a request wait for its turn, behind the others of its session.
  void Wait(ActQueue* from, std::shared_ptr<QueuedAct> act);
  // Handles a part of the first request of one session that waits.
  void DecideWaiting(StepBudget* budget);
  // Takes over session `id`, for whose first request that waits it is not here.
  void Claim(const std::string& id);
  void OnClaimed(const std::string& id, const absl::Status& claimed);
  // Hands a request that is finished to the loop that it came from.
  void Deliver(Waiting decided);
  // Makes sure that Run() is called for what was added.
  void AskForTurn();

  const PolicyHandler& handler_;
  TransportLoop& loop_;
  std::vector<ActQueue*> queues_;
  std::vector<Acts> added_;  // by the loop that the session belongs to
  std::vector<std::shared_ptr<Foreign>> foreign_;
  std::deque<std::shared_ptr<QueuedBatch>> batches_;
  // By session, requests that wait, and those behind them: requests with many beats, of which each
  // turn handles a part of one, and requests whose session is being taken over. And the sessions
  // that are not, in the order of their turns.
  absl::flat_hash_map<std::string, std::deque<Waiting>> waiting_;
  std::deque<std::string> turns_;
  bool batch_is_first_ = false;  // in the next turn that both a batch and another wait for
  bool running_ = false;         // in Run(), and no further turn was asked for
};

}  // namespace spikeserve
