// What every call needs, whatever its handler.
#ifndef SERVER_RPC_SERVICE_PARTS_H_
#define SERVER_RPC_SERVICE_PARTS_H_

#include <cstdint>

#include "core/base/clock.h"
#include "server/access/authenticator.h"
#include "server/base/background_worker.h"
#include "server/metrics/metrics.h"
#include "server/rpc/call_tracker.h"

namespace spikeserve {

// All must outlive the call, and are thread-safe.
struct ServiceParts {
  CallTracker* calls;
  const Authenticator* authenticator;
  Metrics* metrics;
  const Clock* clock;
  BackgroundWorker* worker;   // of calls that may take long
  int64_t max_message_bytes;  // of one request, whoever sends it
};

}  // namespace spikeserve

#endif  // SERVER_RPC_SERVICE_PARTS_H_
