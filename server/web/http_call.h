// A call that came by HTTP/1.1: the answerers of gRPC calls answer it on a loop of the transport,
// so it is counted, delayed and measured like theirs. Rights, size and rate are checked before any
// of its body is read, and workers read the body.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/access/authenticator.h"
#include "server/base/background_worker.h"
#include "server/base/method.h"
#include "server/base/shared_places.h"
#include "server/metrics/metrics.h"
#include "server/transport/call.h"
#include "server/transport/limits.h"
#include "server/transport/transport.h"
#include "server/web/http_message.h"

namespace spikeserve {

// A call to start.
struct HttpCallStart {
  const Method* method;
  HttpRequest request;  // with a caller whom HttpCalls::Admit() has admitted
  // Makes the serialized message. Runs on a worker for a request with a body; an error ends the
  // call.
  std::function<absl::StatusOr<std::string>(HttpRequest* request)> read;
  absl::Duration timeout = absl::InfiniteDuration();
};

// Takes the end of a call: its response as serialized bytes, or its error. Called once, on any
// thread.
using HttpCallDone = std::function<void(const absl::StatusOr<std::string>& response)>;

// Starts calls on the loops of a transport, in turn.
//
// Thread-safe. To be destroyed after the transport was stopped, and before it is destroyed.
class HttpCalls {
 public:
  // All must outlive the calls.
  struct Parts {
    Transport* transport;  // its loops have their routers
    const Authenticator* authenticator;
    Metrics* metrics;
    const Clock* clock;
    TransportLimits limits;
    int64_t max_message_bytes;  // of one message of any tenant
  };

  explicit HttpCalls(const Parts& parts);
  ~HttpCalls();
  HttpCalls(const HttpCalls&) = delete;
  HttpCalls& operator=(const HttpCalls&) = delete;

  // Admits the caller of a request whose message has at least `message_bytes`, and counts the call,
  // or its first decision, at the rates of the tenant. An error is counted; its answer is to be
  // sent after `delay`. Errors are those of Admit(), CheckSize(), and of the rates.
  absl::StatusOr<AcceptedBody> Admit(const HttpRequest& request, const Method& method,
                                     int64_t message_bytes, absl::Duration* delay);

  // The length of the longest message of any tenant.
  int64_t max_message_bytes() const { return parts_.max_message_bytes; }

  // `done` gets UNAVAILABLE if the tenant has as many calls as it may have at a time.
  void Start(HttpCallStart start, HttpCallDone done);

 private:
  class HttpCall;
  struct Loop;
  // A call that the loops have not started.
  struct Waiting;

  static constexpr int64_t kMostCalls = 512;  // at a time; one tenant has half of them

  void RunOnLoop(std::shared_ptr<Waiting> waiting, absl::StatusOr<std::string> message);
  // Calls `done` with a response; a long one on a worker.
  void Answer(const std::shared_ptr<Waiting>& waiting, absl::StatusOr<std::string> response);

  const Parts parts_;
  std::vector<std::unique_ptr<Loop>> loops_;
  std::atomic<uint64_t> next_ = 0;
  SharedPlaces places_;
  // A long body waits for long ones only. Declared last, because their work uses the members above.
  BackgroundWorker short_bodies_;
  BackgroundWorker long_bodies_;
};

}  // namespace spikeserve
