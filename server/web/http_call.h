// A call that came by HTTP/1.1: the answerers of gRPC calls answer it on a loop of the transport,
// so it is admitted, counted, delayed and measured like theirs.
//
// Confined to the thread of its loop, except that Start() may be called on any.
#ifndef SERVER_WEB_HTTP_CALL_H_
#define SERVER_WEB_HTTP_CALL_H_

#include <atomic>
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
#include "server/transport/call.h"
#include "server/transport/limits.h"
#include "server/transport/transport.h"

namespace spikeserve {

// A call to start.
struct HttpCallStart {
  CallHead head;       // without a deadline
  std::string client;  // IP address
  absl::Duration timeout = absl::InfiniteDuration();
  absl::StatusOr<std::string> message;  // serialized; an error ends the call once it is admitted
};

// Takes the end of a call: its response as serialized bytes, or its error. Called once, on the
// call's loop.
using HttpCallDone = std::function<void(const absl::StatusOr<std::string>& response)>;

// Starts calls on the loops of a transport, in turn.
//
// Thread-safe. To be destroyed after the transport was stopped, and before it is destroyed.
class HttpCalls {
 public:
  // REQUIRES: the loops of `transport` have their routers.
  HttpCalls(Transport* transport, const TransportLimits& limits);
  ~HttpCalls();
  HttpCalls(const HttpCalls&) = delete;
  HttpCalls& operator=(const HttpCalls&) = delete;

  void Start(HttpCallStart start, HttpCallDone done);

 private:
  class HttpCall;
  struct Loop;

  static constexpr int64_t kMostCalls = 256;  // at a time

  Transport& transport_;
  const TransportLimits limits_;
  std::vector<std::unique_ptr<Loop>> loops_;
  std::atomic<uint64_t> next_ = 0;
  std::atomic<int64_t> calls_ = 0;
};

}  // namespace spikeserve

#endif  // SERVER_WEB_HTTP_CALL_H_
