#include "server/services/act_queue.h"

#include <utility>

#include "absl/functional/function_ref.h"
#include "absl/hash/hash.h"
#include "absl/types/span.h"

namespace spikeserve {
namespace {

// Decides `acts` and calls `answered(first, statuses of the group)` for each group.
void DecideGroups(const PolicyHandler& handler, absl::Span<const ActQueue::Act> acts,
                  DeferredWork* deferred,
                  absl::FunctionRef<void(size_t first, absl::Span<const AgentAct>)> answered) {
  std::vector<AgentAct> requests;
  requests.reserve(acts.size());
  for (const ActQueue::Act& act : acts) {
    requests.push_back({.caller = act.caller,
                        .request = act.messages->request(),
                        .response = act.messages->response()});
  }
  handler.ActMany(absl::MakeSpan(requests), deferred, [&](absl::Span<AgentAct> group) {
    answered(static_cast<size_t>(group.data() - requests.data()), group);
  });
}

}  // namespace

void ActQueue::SetQueues(std::vector<ActQueue*> queues) {
  queues_ = std::move(queues);
  added_.resize(queues_.size());
}

void ActQueue::Add(Act act) {
  const size_t owner = queues_.size() == 1
                           ? 0
                           : absl::HashOf(act.messages->request()->session_id()) % queues_.size();
  added_[owner].push_back(std::move(act));
  AskForTurn();
}

void ActQueue::AddBatch(std::shared_ptr<ActBatchClient> batch) {
  batches_.push_back(std::move(batch));
  AskForTurn();
}

void ActQueue::AskForTurn() {
  // A request that is read while the queue runs needs another turn.
  if (std::exchange(running_, false)) loop_.events().Post([] {});
}

void ActQueue::Run() {
  running_ = true;
  for (size_t i = 0; i < queues_.size(); ++i) {
    if (added_[i].empty()) continue;
    std::vector<Act> acts = std::exchange(added_[i], {});
    if (queues_[i] == this) {
      Decide(std::move(acts));
      continue;
    }
    auto batch = std::make_shared<Batch>(Batch{this, std::move(acts), {}});
    queues_[i]->loop_.events().Post(
        [owner = queues_[i], batch] { owner->foreign_.push_back(batch); });
  }
  for (const auto& batch : std::exchange(foreign_, {})) DecideForeign(batch);
  if (!batches_.empty()) DecideBatchGroup();
  if (!batches_.empty()) AskForTurn();
  running_ = false;
}

void ActQueue::DecideBatchGroup() {
  const std::shared_ptr<ActBatchClient> batch = std::move(batches_.front());
  batches_.pop_front();
  DeferredWork deferred;
  const bool done = batch->DecideGroup(handler_, &deferred);
  loop_.FlushWrites();
  deferred.Run();
  if (!done) batches_.push_back(batch);
}

void ActQueue::Decide(std::vector<Act> acts) {
  DeferredWork deferred;
  DecideGroups(handler_, acts, &deferred, [&](size_t first, absl::Span<const AgentAct> group) {
    for (size_t i = 0; i < group.size(); ++i) {
      Act& act = acts[first + i];
      act.client->OnDecided(*act.messages, group[i].status, act.request_bytes, act.received);
    }
    loop_.FlushWrites();
    deferred.Run();
  });
}

void ActQueue::DecideForeign(const std::shared_ptr<Batch>& batch) {
  DeferredWork deferred;
  DecideGroups(handler_, batch->acts, &deferred,
               [&](size_t /*first*/, absl::Span<const AgentAct> group) {
                 for (const AgentAct& act : group) batch->statuses.push_back(act.status);
               });
  batch->from->loop_.events().Post([batch] {
    for (size_t i = 0; i < batch->acts.size(); ++i) {
      const Act& act = batch->acts[i];
      act.client->OnDecided(*act.messages, batch->statuses[i], act.request_bytes, act.received);
    }
    batch->acts.clear();  // the calls are destroyed on their loop's thread
  });
  deferred.Run();
}

}  // namespace spikeserve
