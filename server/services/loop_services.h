// Routes the calls of one event loop to handlers, and runs the queued decisions at the end of each
// turn.
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/container/flat_hash_map.h"
#include "absl/strings/string_view.h"
#include "server/agent/deferred_work.h"
#include "server/agent/policy_handler.h"
#include "server/services/act_queue.h"
#include "server/transport/call.h"
#include "server/transport/transport_loop.h"

namespace spikeserve {

class LoopServices;

// The methods that the server has, by path. Immutable after it was filled, and then thread-safe.
class ServiceTable {
 public:
  // Returns the handler of a new call on the loop that `services` belongs to.
  using Open = std::function<std::shared_ptr<CallHandler>(Call* call, LoopServices* services)>;

  // Adds the method at "/package.Service/Method".
  void Add(std::string path, Open open) { methods_.emplace(std::move(path), std::move(open)); }

  // Returns null if the server has no such method.
  const Open* Find(absl::string_view path) const {
    const auto found = methods_.find(path);
    return found == methods_.end() ? nullptr : &found->second;
  }

 private:
  absl::flat_hash_map<std::string, Open> methods_;
};

// Confined to the thread of its loop.
class LoopServices final : public CallRouter {
 public:
  // All pointers must outlive the object.
  LoopServices(const ServiceTable* table, const PolicyHandler* handler, TransportLoop* loop)
      : table_(*table), loop_(*loop), acts_(handler, loop) {}

  // Answers the calls of the loop from now on. `all` are the services of all loops, in the same
  // order for each. To be called once, before the loop runs.
  void Attach(const std::vector<std::unique_ptr<LoopServices>>& all);

  // Returns a handler that refuses the call with UNIMPLEMENTED if its path is unknown.
  std::shared_ptr<CallHandler> Route(Call* call) override;

  ActQueue& acts() { return acts_; }
  // Returns work that is done at the end of the turn, after the answers were sent.
  DeferredWork& deferred() { return deferred_; }

 private:
  const ServiceTable& table_;
  TransportLoop& loop_;
  ActQueue acts_;
  DeferredWork deferred_;
};

}  // namespace spikeserve
