// Where a caller hands over its requests and gets the answers, however they travel.
//
// An exchange belongs to one thread.
#ifndef LOADTEST_EXCHANGE_H_
#define LOADTEST_EXCHANGE_H_

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

  // Hands over a request without waiting for its answer.
  virtual absl::Status Send(const v1::ActRequest& request) = 0;

  // The next answer to any request. DEADLINE_EXCEEDED if none came within `timeout`; the requests
  // are still under way then. After any other error none of them will be answered. A batch waits
  // for its answer, however long that takes; without a request it is FAILED_PRECONDITION.
  virtual absl::StatusOr<ActReply> Receive(absl::Duration timeout) = 0;
};

// `batch_size` as in LoadOptions. `client` must outlive the exchange.
std::unique_ptr<Exchange> MakeExchange(LoadMode mode, int batch_size, Client* client);

}  // namespace spikeserve

#endif  // LOADTEST_EXCHANGE_H_
