#include "server/services/act_queue.h"

#include <utility>

#include "absl/container/inlined_vector.h"
#include "absl/hash/hash.h"
#include "absl/types/span.h"

namespace spikeserve {
namespace {

absl::InlinedVector<DecisionRequest*, 1> RequestsOf(
    absl::Span<const std::shared_ptr<QueuedAct>> acts) {
  absl::InlinedVector<DecisionRequest*, 1> requests;
  requests.reserve(acts.size());
  for (const auto& act : acts) requests.push_back(&act->act());
  return requests;
}

}  // namespace

void ActQueue::SetQueues(std::vector<ActQueue*> queues) {
  queues_ = std::move(queues);
  added_.resize(queues_.size());
}

void ActQueue::Add(std::shared_ptr<QueuedAct> act) {
  const size_t owner =
      queues_.size() == 1 ? 0 : absl::HashOf(act->act().request->session_id()) % queues_.size();
  added_[owner].push_back(std::move(act));
  AskForTurn();
}

void ActQueue::AddBatch(std::shared_ptr<QueuedBatch> batch) {
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
    Acts acts = std::exchange(added_[i], {});
    if (queues_[i] == this) {
      Decide(acts);
      continue;
    }
    auto foreign = std::make_shared<Foreign>(Foreign{this, std::move(acts)});
    queues_[i]->loop_.events().Post(
        [owner = queues_[i], foreign] { owner->foreign_.push_back(foreign); });
  }
  for (const auto& foreign : std::exchange(foreign_, {})) DecideForeign(foreign);
  if (!batches_.empty()) DecideBatchGroup();
  if (!batches_.empty()) AskForTurn();
  running_ = false;
}

void ActQueue::DecideBatchGroup() {
  const std::shared_ptr<QueuedBatch> batch = std::move(batches_.front());
  batches_.pop_front();
  DeferredWork deferred;
  const bool done = batch->DecideGroup(handler_, &deferred);
  loop_.FlushWrites();
  deferred.Run();
  if (!done) batches_.push_back(batch);
}

void ActQueue::Decide(const Acts& acts) {
  DeferredWork deferred;
  const auto requests = RequestsOf(acts);
  size_t answered = 0;
  handler_.ActMany(requests, &deferred, [&](absl::Span<DecisionRequest* const> group) {
    for (size_t i = 0; i < group.size(); ++i) acts[answered + i]->OnDecided();
    answered += group.size();
    loop_.FlushWrites();
    deferred.Run();
  });
}

void ActQueue::DecideForeign(const std::shared_ptr<Foreign>& foreign) {
  DeferredWork deferred;
  handler_.ActMany(RequestsOf(foreign->acts), &deferred,
                   [](absl::Span<DecisionRequest* const> /*group*/) {});
  foreign->from->loop_.events().Post([foreign] {
    for (const auto& act : foreign->acts) act->OnDecided();
    foreign->acts.clear();  // the calls are destroyed on their loop's thread
  });
  deferred.Run();
}

}  // namespace spikeserve
