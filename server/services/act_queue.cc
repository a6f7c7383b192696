#include "server/services/act_queue.h"

#include <utility>

#include "absl/functional/function_ref.h"
#include "absl/hash/hash.h"
#include "absl/types/span.h"

namespace spikeserve {
namespace {

// Decides `acts` and calls `answered(first, statuses of the group)` for each group.
void DecideGroups(const PolicyHandler& handler, absl::Span<const ActQueue::Act> acts,
                  bool may_claim, DeferredWork* deferred,
                  absl::FunctionRef<void(size_t first, absl::Span<const AgentAct>)> answered) {
  std::vector<AgentAct> requests;
  requests.reserve(acts.size());
  for (const ActQueue::Act& act : acts) {
    requests.push_back({.caller = act.caller,
                        .request = act.messages->request(),
                        .response = act.messages->response(),
                        .may_claim = may_claim && !act.recovered,
                        .received = act.received,
                        .beats = act.beats});
  }
  handler.ActMany(absl::MakeSpan(requests), deferred, [&](absl::Span<AgentAct> group) {
    answered(static_cast<size_t>(group.data() - requests.data()), group);
  });
}

bool IsFinished(const AgentAct& act) { return act.beats.finished || !act.status.ok(); }

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
    auto batch = std::make_shared<Batch>(Batch{this, std::move(acts), {}, {}});
    queues_[i]->loop_.events().Post(
        [owner = queues_[i], batch] { owner->foreign_.push_back(batch); });
  }
  for (const auto& batch : std::exchange(foreign_, {})) DecideForeign(batch);
  if (!batches_.empty()) DecideBatchGroup();
  if (!turns_.empty()) DecideWaiting();
  if (!batches_.empty() || !turns_.empty()) AskForTurn();
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

void ActQueue::Wait(ActQueue* from, Act act) {
  const std::string& id = act.messages->request()->session_id();
  std::deque<Waiting>& behind = waiting_[id];
  if (behind.empty()) turns_.push_back(id);
  behind.push_back({from, std::move(act)});
}

std::vector<ActQueue::Act> ActQueue::HoldBack(ActQueue* from, std::vector<Act> acts) {
  if (waiting_.empty()) return acts;
  std::vector<Act> others;
  for (Act& act : acts) {
    if (waiting_.contains(act.messages->request()->session_id())) {
      Wait(from, std::move(act));
    } else {
      others.push_back(std::move(act));
    }
  }
  return others;
}

void ActQueue::DecideWaiting() {
  const std::string id = std::move(turns_.front());
  turns_.pop_front();
  std::deque<Waiting>& behind = waiting_[id];
  Waiting first = std::move(behind.front());
  behind.pop_front();
  DeferredWork deferred;
  DecideGroups(handler_, absl::MakeConstSpan(&first.act, 1), recovery_ != nullptr, &deferred,
               [&](size_t /*first*/, absl::Span<const AgentAct> group) {
                 if (group.empty()) return;
                 const AgentAct& act = group[0];
                 if (!IsFinished(act)) {
                   first.act.beats = act.beats;
                   behind.push_front(std::move(first));
                 } else if (first.from == this) {
                   Answer(first.act, act.status, act.commits);
                 } else {
                   // The call is destroyed on the thread of its loop.
                   first.from->loop_.events().Post(
                       [from = first.from, act = std::move(first.act), status = act.status,
                        commits = act.commits] { from->Answer(act, status, commits); });
                 }
               });
  if (behind.empty()) {
    waiting_.erase(id);
  } else {
    turns_.push_back(id);
  }
  loop_.FlushWrites();
  deferred.Run();
}

void ActQueue::Decide(std::vector<Act> added) {
  const std::vector<Act> acts = HoldBack(this, std::move(added));
  DeferredWork deferred;
  DecideGroups(handler_, acts, recovery_ != nullptr, &deferred,
               [&](size_t first, absl::Span<const AgentAct> group) {
                 for (size_t i = 0; i < group.size(); ++i) {
                   const Act& act = acts[first + i];
                   if (IsFinished(group[i])) {
                     Answer(act, group[i].status, group[i].commits);
                   } else {
                     Act again = act;
                     again.beats = group[i].beats;
                     Wait(this, std::move(again));
                   }
                 }
                 loop_.FlushWrites();
                 deferred.Run();
               });
}

void ActQueue::DecideForeign(const std::shared_ptr<Batch>& batch) {
  std::vector<Act> acts = HoldBack(batch->from, std::exchange(batch->acts, {}));
  DeferredWork deferred;
  DecideGroups(handler_, acts, recovery_ != nullptr, &deferred,
               [&](size_t first, absl::Span<const AgentAct> group) {
                 for (size_t i = 0; i < group.size(); ++i) {
                   Act& act = acts[first + i];
                   if (IsFinished(group[i])) {
                     batch->acts.push_back(std::move(act));
                     batch->statuses.push_back(group[i].status);
                     batch->commits.push_back(group[i].commits);
                   } else {
                     act.beats = group[i].beats;
                     Wait(batch->from, std::move(act));
                   }
                 }
               });
  batch->from->loop_.events().Post([batch] {
    for (size_t i = 0; i < batch->acts.size(); ++i) {
      batch->from->Answer(batch->acts[i], batch->statuses[i], batch->commits[i]);
    }
    batch->acts.clear();  // the calls are destroyed on their loop's thread
  });
  deferred.Run();
}

void ActQueue::Answer(const Act& act, const absl::Status& status, const Commits& commits) {
  if (recovery_ != nullptr && absl::IsNotFound(status) && !act.recovered) {
    return Recover(act, status);
  }
  if (commits.empty()) {
    return act.client->OnDecided(*act.messages, status, act.request_bytes, act.received);
  }
  if (status.ok()) act.client->OnGranted();
  // The act is moved on, because a call must be destroyed on the thread of its loop.
  WhenDurable(commits, [act, status,
                        loop = &loop_.events()](const std::vector<absl::Status>& outcomes) mutable {
    loop->Post([act = std::move(act), outcome = status.ok() ? outcomes[0] : status] {
      act.client->OnDecided(*act.messages, outcome, act.request_bytes, act.received);
    });
  });
}

void ActQueue::Recover(const Act& act, const absl::Status& status) {
  const auto post = [loop = &loop_.events()](std::function<void()> work) {
    loop->Post(std::move(work));
  };
  Act again = act;
  again.recovered = true;
  recovery_->Recover(*act.caller, act.messages->request()->session_id(), post,
                     [this, again = std::move(again), status](const absl::Status& recovered) {
                       if (recovered.ok()) return Add(again);
                       Answer(again, absl::IsNotFound(recovered) ? status : recovered, {});
                     });
}

}  // namespace spikeserve
