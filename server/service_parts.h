// What every call needs.
#ifndef SERVER_SERVICE_PARTS_H_
#define SERVER_SERVICE_PARTS_H_

#include <cstdint>

#include "core/session/clock.h"
#include "server/authenticator.h"
#include "server/background_worker.h"
#include "server/call_tracker.h"
#include "server/metrics.h"
#include "server/request_handler.h"

namespace spikeserve {

// All must outlive the call, and are thread-safe.
struct ServiceParts {
  const RequestHandler* handler;
  CallTracker* calls;
  const Authenticator* authenticator;
  Metrics* metrics;
  const Clock* clock;
  BackgroundWorker* worker;   // of calls that may take long
  int64_t max_message_bytes;  // of one request, whoever sends it
};

}  // namespace spikeserve

#endif  // SERVER_SERVICE_PARTS_H_
