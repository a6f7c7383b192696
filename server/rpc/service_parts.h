// The objects that every call uses, independent of its handler.
#ifndef SERVER_RPC_SERVICE_PARTS_H_
#define SERVER_RPC_SERVICE_PARTS_H_

#include <cstdint>

#include "core/base/clock.h"
#include "server/access/authenticator.h"
#include "server/base/background_worker.h"
#include "server/metrics/metrics.h"
#include "server/rpc/call_tracker.h"

namespace spikeserve {

// All are thread-safe and must outlive the call.
struct ServiceParts {
  CallTracker* calls;
  const Authenticator* authenticator;
  Metrics* metrics;
  const Clock* clock;
  BackgroundWorker* worker;   // runs the calls that take long
  int64_t max_message_bytes;  // of one request of any tenant
};

}  // namespace spikeserve

#endif  // SERVER_RPC_SERVICE_PARTS_H_
