// What all services share.
#pragma once

#include <cstdint>
#include <functional>
#include <utility>

#include "core/base/clock.h"
#include "server/access/authenticator.h"
#include "server/agent/session_gate.h"
#include "server/agent/session_recovery.h"
#include "server/metrics/metrics.h"
#include "server/services/call_gate.h"
#include "server/transport/event_loop.h"

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

// Returns a function that runs work on the thread of `loop`.
inline SessionRecovery::Post PostTo(EventLoop* loop) {
  return [loop](std::function<void()> work) { loop->Post(std::move(work)); };
}

}  // namespace spikeserve
