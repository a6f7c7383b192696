// grpc.health.v1.Health: tells load balancers and watchers which services are served.
//
// Source: gRPC's health checking protocol.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "grpc/health/v1/health.pb.h"
#include "server/transport/call.h"

namespace spikeserve {

// Thread-safe.
class HealthService {
 public:
  using ServingStatus = grpc::health::v1::HealthCheckResponse::ServingStatus;

  // Sets the status of `service` and tells its watchers. The empty name is the whole server.
  void SetServing(const std::string& service, bool serving);

  // Ends all watches, which have no end of their own, with UNAVAILABLE.
  void EndWatches();

  // Return the handlers of one call of Check and of Watch. Any caller may make them. The service
  // must outlive the calls.
  std::shared_ptr<CallHandler> Check(Call* call);
  std::shared_ptr<CallHandler> Watch(Call* call);

 private:
  class CheckCall;
  class WatchCall;

  // Returns SERVICE_UNKNOWN for a service that was never set.
  ServingStatus StatusOf(const std::string& service);
  // Adds a watcher, which is told about changes of any service.
  void AddWatcher(const std::shared_ptr<WatchCall>& watcher);
  std::vector<std::shared_ptr<WatchCall>> Watchers();

  absl::Mutex mutex_;
  absl::flat_hash_map<std::string, ServingStatus> services_ ABSL_GUARDED_BY(mutex_);
  std::vector<std::weak_ptr<WatchCall>> watchers_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
