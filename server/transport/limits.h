// What one client, or all clients together, may ask of the transport.
#pragma once

#include <cstdint>

#include "absl/status/status.h"
#include "absl/time/time.h"

namespace spikeserve {

// Plain data, safe to read from many threads. The defaults are safe for a port that anybody
// can reach.
struct TransportLimits {
  // Of one connection. A client that exceeds one of the rates loses its connection
  // (ENHANCE_YOUR_CALM).
  int64_t max_streams = 100;            // calls at a time; further calls are refused
  int64_t max_header_bytes = 16 << 10;  // of one request, as RFC 9113 counts them
  int64_t max_headers = 128;            // of one request
  int64_t max_resets_per_second = 200;  // RST_STREAM, and calls that the server has to reset
  int64_t max_control_frames_per_second =
      200;                                  // PING, SETTINGS, PRIORITY, WINDOW_UPDATE and empty
                                            // DATA, beyond those that answer the server's frames
  int64_t max_connection_bytes = 16 << 20;  // of requests that wait and answers not yet sent

  // Of all connections.
  int64_t max_tenant_bytes = 128 << 20;     // as above, of one tenant
  int64_t max_bytes_in_flight = 256 << 20;  // of requests that wait and answers not yet sent
  int64_t max_connections = 10'000;
  int64_t max_connections_per_address = 1'000;    // of one IPv4 address or IPv6 /64
  int64_t max_connections_per_network = 2'500;    // of one IPv4 /24 or IPv6 /48
  int64_t max_idle_unauthenticated = 500;         // connections that have not made a call yet
  int64_t max_unauthenticated_bytes = 128 << 20;  // of connections none of whose calls was
                                                  // admitted, and of calls without a token

  absl::Duration first_request_timeout = absl::Seconds(10);  // from connect to the first call
  absl::Duration request_timeout = absl::Seconds(30);  // of one message that arrives in pieces
  absl::Duration idle_timeout = absl::Minutes(30);     // of a connection without a call
  absl::Duration write_timeout = absl::Seconds(30);    // of a client that reads no answers
  // A client that has sent nothing for this time while a call is open gets a PING, which it answers
  // within the timeout, or the connection is closed.
  absl::Duration keepalive_interval = absl::Seconds(20);
  absl::Duration keepalive_timeout = absl::Seconds(10);
  absl::Duration max_connection_age = absl::InfiniteDuration();

  // Returns INVALID_ARGUMENT, which names the flag, what was expected and what was received.
  absl::Status Validate() const;
};

// RESOURCE_EXHAUSTED for a call whose bytes, with those in flight, exceed one of the limits above.
absl::Status TooManyBytesError();

}  // namespace spikeserve
