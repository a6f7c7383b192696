// The services as one event loop sees them: finds the answerers of its calls, and does what the
// turn has gathered.
//
// Confined to the thread of its loop.
#ifndef SERVER_SERVICES_LOOP_SERVICES_H_
#define SERVER_SERVICES_LOOP_SERVICES_H_

#include <memory>
#include <vector>

#include "server/agent/deferred_work.h"
#include "server/agent/policy_handler.h"
#include "server/services/act_queue.h"
#include "server/services/service_table.h"
#include "server/transport/call.h"
#include "server/transport/transport_loop.h"

namespace spikeserve {

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

#endif  // SERVER_SERVICES_LOOP_SERVICES_H_
