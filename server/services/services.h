// Connects the methods of every service with the handlers that answer them.
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/container/flat_hash_map.h"
#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "server/admin/admin_handler.h"
#include "server/admin/audit.h"
#include "server/agent/policy_handler.h"
#include "server/base/background_worker.h"
#include "server/base/method.h"
#include "server/inference/inference_handler.h"
#include "server/services/act_queue.h"
#include "server/services/datagram_calls.h"
#include "server/services/handler_calls.h"
#include "server/services/health_service.h"
#include "server/services/service_context.h"
#include "server/transport/call.h"
#include "server/transport/transport.h"
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

// Routes the calls of one event loop to handlers, and runs the queued decisions at the end of each
// turn. Confined to the thread of its loop.
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

// What answers. All must outlive the services.
struct Handlers {
  const PolicyHandler* policy;
  const AdminHandler* admin;
  const Audit* audit;
  const InferenceHandler* inference;
  HealthService* health;
  BackgroundWorker* worker;        // runs what takes long: Explain, ExportSession
  BackgroundWorker* list_worker;   // runs lists, which are short and come in bursts
  BackgroundWorker* admin_worker;  // runs the calls of operators, some of which use files
  bool reflection_v1alpha;         // serve the old version of reflection, too
};

// PolicyService, PolicyAdmin, GRPCInferenceService, Health and ServerReflection.
//
// Must outlive the transport's run. Thread-safe, except Attach().
class Services {
 public:
  Services(const ServiceContext& context, const Handlers& handlers);

  // Answers the calls of `transport`, and its datagrams. To be called once, before it starts.
  // RESOURCE_EXHAUSTED if the system has no room to wait for datagrams.
  absl::Status Attach(Transport* transport);

 private:
  // Each adds the methods of a service.
  void AddPolicyService();
  void AddPolicyAdmin();
  void AddInferenceService();
  void AddStandardServices();

  // Adds the method of these requests, which `handler` answers, on the loop or on a worker, by its
  // cost.
  void Add(Handler handler);
  // As Add. What only operators may call runs on their own worker and is recorded in the audit log,
  // because it changes something; the rest are lists.
  void AddAdmin(Handler handler);
  void AddRecorded(Handler handler);
  void AddBackground(BackgroundWorker* worker, Handler handler, bool is_recorded = false);
  // Adds a method whose calls `open` opens; they are started here.
  using OpenCall = std::function<std::shared_ptr<ServiceCall>(Call*, const Method&, LoopServices*)>;
  void AddCall(const Method& method, OpenCall open);

  const ServiceContext context_;
  const Handlers handlers_;
  std::vector<std::string> service_names_;
  ServiceTable table_;
  std::vector<std::unique_ptr<DatagramCalls>> datagrams_;  // of the loops; outlive their requests
  std::vector<std::unique_ptr<LoopServices>> loops_;
};

}  // namespace spikeserve
