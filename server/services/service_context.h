// What all services share.
#pragma once

#include <cstdint>

#include "core/base/clock.h"
#include "server/access/authenticator.h"
#include "server/agent/session_gate.h"
#include "server/metrics/metrics.h"
#include "server/services/call_gate.h"

namespace spikeserve {

class DatagramChannels;
class Tracer;

// All are thread-safe and must outlive the calls.
struct ServiceContext {
  CallGate* gate;
  const Authenticator* authenticator;
  Metrics* metrics;
  const Clock* clock;
  int64_t max_message_bytes;  // of one request of any tenant
  const SessionGate* sessions;
  Tracer* tracer = nullptr;               // null: nothing is traced
  DatagramChannels* datagrams = nullptr;  // null: the server takes none
};

}  // namespace spikeserve
