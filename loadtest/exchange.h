// Sends requests and receives their answers, in one of the ways that the service offers: single
// calls, a stream or batches.
//
// Not thread-safe: an exchange is used by one thread.
#pragma once

#include <memory>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "loadtest/load_options.h"
#include "spikeserve/client.h"

namespace spikeserve {

class Exchange {
 public:
  virtual ~Exchange() = default;

  // Sends a request without waiting for its answer. Returns an error if it cannot be sent.
  virtual absl::Status Send(const v1::ActRequest& request) = 0;

  // Returns the next answer to any of the requests. Returns DEADLINE_EXCEEDED if none arrives
  // within `timeout`; the requests then remain in flight. After any other error none of them will
  // be answered. The exchange of batches ignores `timeout` and waits for the answer to its batch;
  // it returns FAILED_PRECONDITION if no request was sent.
  virtual absl::StatusOr<ActReply> Receive(absl::Duration timeout) = 0;

  // Forgets the requests in flight and opens a new stream, after an error.
  virtual void Reset() = 0;
};

// Creates the exchange for `mode`. `batch_size` is LoadOptions::batch_size. `route` is that of
// the sessions, if they have one in common. `client` must outlive the exchange.
std::unique_ptr<Exchange> MakeExchange(LoadMode mode, int batch_size, Client* client,
                                       std::shared_ptr<Route> route = nullptr);

}  // namespace spikeserve
