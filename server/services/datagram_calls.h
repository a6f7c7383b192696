// The steps that arrive as datagrams on one loop. Each is answered as a request of ActStream: by
// the same queue, handler, limits, spans and metrics.
//
// The payload of a datagram is the number of the request (8 bytes, big-endian), which the answer
// repeats, and an ActRequest or ActResponse. An answer that is too long for a datagram is replaced
// by the error OUT_OF_RANGE; the robot then asks on its stream. Nothing is answered to what does
// not authenticate.
//
// Confined to the thread of its loop.
#pragma once

#include <cstdint>
#include <memory>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "server/agent/datagram_channels.h"
#include "server/base/method.h"
#include "server/services/act_queue.h"
#include "server/services/service_context.h"
#include "server/transport/transport_loop.h"

namespace spikeserve {

class DatagramCalls {
 public:
  // `loop` has a socket for datagrams. `max_tenant_bytes` is that of TransportLimits. The pointers
  // must outlive the object, but `queue` may end after `loop`.
  DatagramCalls(const ServiceContext* context, ActQueue* queue, TransportLoop* loop,
                int64_t max_tenant_bytes);

  // Answers datagrams from now on. RESOURCE_EXHAUSTED if the system has no room for that.
  absl::Status Start();

 private:
  class Request;

  void Receive(const SocketAddress& from, absl::string_view datagram);
  // Takes a datagram that names `key`. Returns what became of it.
  DatagramOutcome Take(const std::shared_ptr<DatagramKey>& key, const SocketAddress& from,
                       absl::string_view datagram);
  void Send(DatagramKey::Answers answers);
  // Counts what the requests of a tenant occupy. Returns false if that exceeds a limit.
  bool CountBytes(Tenant& tenant, int64_t bytes);

  const ServiceContext& context_;
  DatagramChannels& channels_;
  ActQueue& queue_;
  TransportLoop& loop_;
  const int64_t max_tenant_bytes_;
  const Method& method_;
};

}  // namespace spikeserve
