#include "server/services/act_queue.h"

#include <utility>

#include "absl/container/inlined_vector.h"
#include "absl/hash/hash.h"
#include "absl/types/span.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// What may be decided together.
template <typename T>
using Group = absl::InlinedVector<T, kMaxSessionsPerGroup>;

}  // namespace

QueuedAct::QueuedAct(const ServiceContext* context, ActQueue* queue)
    : context_(*context), queue_(*queue) {
  act_.context = &call_context();
  act_.request = request();
  act_.response = response();
  act_.received = context->clock->Now();
}

void QueuedAct::Enter(const Credential* caller) {
  call_context().caller = caller;
  context_.sessions->Enter(&call_context());
  act_.Become(DecisionState::kWaiting);
  queue_.Add(shared_from_this());
}

SessionRecovery::Post QueuedAct::post() { return PostTo(&queue_.events()); }

void ActQueue::SetQueues(std::vector<ActQueue*> queues) {
  SPIKESERVE_DCHECK(queues_.empty() && !queues.empty());
  queues_ = std::move(queues);
  added_.resize(queues_.size());
}

void ActQueue::Add(std::shared_ptr<QueuedAct> act) {
  loop_.events().thread().AssertCurrent();
  SPIKESERVE_DCHECK(!queues_.empty());
  const size_t owner =
      queues_.size() == 1 ? 0 : absl::HashOf(act->act().request->session_id()) % queues_.size();
  added_[owner].push_back(std::move(act));
  AskForTurn();
}

void ActQueue::AddBatch(std::shared_ptr<QueuedBatch> batch) {
  loop_.events().thread().AssertCurrent();
  batches_.push_back(std::move(batch));
  AskForTurn();
}

void ActQueue::AskForTurn() {
  // A request that is read while the queue runs needs another turn.
  if (std::exchange(running_, false)) loop_.events().Post([] {});
}

void ActQueue::Run() {
  loop_.events().thread().AssertCurrent();
  running_ = true;
  // The beats of one turn are bounded, whatever the number of sessions. Requests that wait for
  // their next part come before new ones.
  StepBudget budget = handler_.NewBudget();
  StepBudget none = {.steps = 0};
  StepBudget* const of_new = batches_.empty() && turns_.empty() ? &budget : &none;
  for (size_t i = 0; i < queues_.size(); ++i) {
    if (added_[i].empty()) continue;
    Acts acts = std::exchange(added_[i], {});
    if (queues_[i] == this) {
      Decide(std::move(acts), of_new);
      continue;
    }
    auto foreign = std::make_shared<Foreign>(Foreign{this, std::move(acts)});
    queues_[i]->loop_.events().Post(
        [owner = queues_[i], foreign] { owner->foreign_.push_back(foreign); });
  }
  for (const auto& foreign : std::exchange(foreign_, {})) DecideForeign(foreign, of_new);
  batch_is_first_ = !batch_is_first_;
  if (!batches_.empty()) DecideBatchGroup(turns_.empty() || batch_is_first_ ? &budget : &none);
  if (!turns_.empty()) DecideWaiting(&budget);
  if (!batches_.empty() || !turns_.empty()) AskForTurn();
  running_ = false;
}

void ActQueue::DecideBatchGroup(StepBudget* budget) {
  const std::shared_ptr<QueuedBatch> batch = std::move(batches_.front());
  batches_.pop_front();
  DeferredWork deferred;
  const bool done = batch->DecideGroup(handler_, &deferred, budget);
  loop_.FlushWrites();
  deferred.Run();
  if (!done) batches_.push_back(batch);
}

void ActQueue::Wait(ActQueue* from, std::shared_ptr<QueuedAct> act) {
  const std::string& id = act->act().request->session_id();
  std::deque<Waiting>& behind = waiting_[id];
  behind.push_back({from, std::move(act)});
  if (behind.size() > 1) return;
  if (behind.front().act->act().state == DecisionState::kClaiming) return Claim(id);
  turns_.push_back(id);
}

void ActQueue::Claim(const std::string& id) {
  const auto post = PostTo(&loop_.events());
  // Posted in any case, because the claim may end at once, before earlier answers are on their way.
  handler_.Claim(waiting_[id].front().act->act(), post, [this, id, post](const absl::Status& done) {
    post([this, id, done] { OnClaimed(id, done); });
  });
}

// What the store has said holds for all requests of the tenant that have waited.
void ActQueue::OnClaimed(const std::string& id, const absl::Status& claimed) {
  loop_.events().thread().AssertCurrent();
  std::deque<Waiting> all = std::exchange(waiting_[id], {});
  const auto tenant_of = [](const Waiting& waiting) {
    return waiting.act->act().context->caller->tenant();
  };
  const auto tenant = tenant_of(all.front());
  std::deque<Waiting> behind;
  for (Waiting& waiting : all) {
    DecisionRequest& act = waiting.act->act();
    const bool is_told = tenant_of(waiting) == tenant;
    if (is_told) {
      act.OnClaimed(claimed);
    }
    if (is_told && !claimed.ok()) {
      Deliver(std::move(waiting));
    } else {
      behind.push_back(std::move(waiting));
    }
  }
  if (behind.empty()) {
    waiting_.erase(id);
    return;
  }
  waiting_[id] = std::move(behind);
  turns_.push_back(id);
  AskForTurn();
}

void ActQueue::Deliver(Waiting decided) {
  if (decided.from == this) return decided.act->Leave();
  // Moved on, because the call is destroyed on its loop's thread.
  decided.from->loop_.events().Post([act = std::move(decided.act)] { act->Leave(); });
}

void ActQueue::DecideWaiting(StepBudget* budget) {
  const std::string id = std::move(turns_.front());
  turns_.pop_front();
  std::deque<Waiting>& behind = waiting_[id];
  Waiting first = std::move(behind.front());
  behind.pop_front();
  DeferredWork deferred;
  handler_.ActGroup({&first.act->act()}, &deferred, budget);
  const bool is_decided = first.act->act().is_decided();
  const bool is_claiming = first.act->act().state == DecisionState::kClaiming;
  if (is_decided) {
    Deliver(std::move(first));
  } else {
    behind.push_front(std::move(first));
  }
  if (behind.empty()) {
    waiting_.erase(id);
  } else if (is_claiming) {
    Claim(id);
  } else {
    turns_.push_back(id);
  }
  loop_.FlushWrites();
  deferred.Run();
}

ActQueue::Acts ActQueue::DecideGroup(ActQueue* from, absl::Span<std::shared_ptr<QueuedAct>>* acts,
                                     DeferredWork* deferred, StepBudget* budget) {
  Group<std::shared_ptr<QueuedAct>> group;
  Group<DecisionRequest*> requests;
  size_t next = 0;
  for (; next < acts->size() && group.size() < kMaxSessionsPerGroup; ++next) {
    std::shared_ptr<QueuedAct>& act = (*acts)[next];
    if (!waiting_.empty() && waiting_.contains(act->act().request->session_id())) {
      Wait(from, std::move(act));
    } else {
      requests.push_back(&act->act());
      group.push_back(std::move(act));
    }
  }
  Acts decided;
  const size_t end = group.empty() ? 0 : handler_.ActGroup(requests, deferred, budget);
  for (size_t i = 0; i < end; ++i) {
    if (group[i]->act().is_decided()) {
      decided.push_back(std::move(group[i]));
    } else {
      Wait(from, std::move(group[i]));
    }
  }
  for (; group.size() > end; group.pop_back()) (*acts)[--next] = std::move(group.back());
  acts->remove_prefix(next);
  return decided;
}

void ActQueue::Decide(Acts acts, StepBudget* budget) {
  for (auto rest = absl::MakeSpan(acts); !rest.empty();) {
    DeferredWork deferred;
    for (const auto& act : DecideGroup(this, &rest, &deferred, budget)) act->Leave();
    loop_.FlushWrites();
    deferred.Run();
  }
}

void ActQueue::DecideForeign(const std::shared_ptr<Foreign>& foreign, StepBudget* budget) {
  Acts acts = std::exchange(foreign->acts, {});
  DeferredWork deferred;
  for (auto rest = absl::MakeSpan(acts); !rest.empty();) {
    for (auto& act : DecideGroup(foreign->from, &rest, &deferred, budget)) {
      foreign->acts.push_back(std::move(act));
    }
  }
  foreign->from->loop_.events().Post([foreign] {
    for (const auto& act : foreign->acts) act->Leave();
    foreign->acts.clear();  // the calls are destroyed on their loop's thread
  });
  deferred.Run();
}

}  // namespace spikeserve
