// The interfaces between the transport and the services: a call, what answers it, and what finds
// the answerer of a new call.
//
// Everything here is confined to the thread of one event loop, except where a comment says
// otherwise.
#pragma once

#include <google/protobuf/message_lite.h>

#include <cstddef>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "server/base/byte_budget.h"
#include "server/base/peer.h"
#include "server/base/trace_parent.h"
#include "server/transport/event_loop.h"

namespace spikeserve {

class Credential;

// What the client sent before its first message, and what is known of it.
struct CallHead {
  std::string path;           // "/package.Service/Method"
  std::string authorization;  // value of the header; empty: none
  // Set if the caller was admitted, and the call, or its first decision, counted at its rates.
  std::shared_ptr<const Credential> admitted = nullptr;
  absl::Duration deadline = absl::InfiniteDuration();  // of the loop's clock
  TraceParent trace = {};  // of the header `traceparent`; not valid: none
};

// One call. Valid until CallHandler::OnClosed() returns.
class Call {
 public:
  virtual ~Call() = default;

  virtual const CallHead& head() const = 0;
  virtual EventLoop& loop() = 0;
  // Returns the client's address and certificate. Reads them from the system at each call.
  virtual Peer peer() const = 0;

  // Queues `message`, which is sent at the end of the loop's turn. Does nothing if the call has
  // been finished, by Finish() or by its deadline.
  virtual void Send(const google::protobuf::MessageLite& message) = 0;

  // As Send(), for a message that AppendMessage() has framed: another thread can do that.
  virtual void SendFramed(std::string framed) = 0;

  // Ends the call with `status` after the messages that are queued. Further messages of the client
  // are dropped; OnClosed() follows later. Does nothing if the call has been finished.
  virtual void Finish(const absl::Status& status) = 0;

  // Stops calling OnMessage(), and so, by flow control, the client, until ResumeReading().
  virtual void PauseReading() = 0;
  virtual void ResumeReading() = 0;

  // The caller is known. Counts the bytes that the call stores as those of its tenant, too, which
  // may not exceed TransportLimits::max_tenant_bytes.
  virtual void Admit(std::shared_ptr<ByteBudget> tenant) = 0;

  // Drops the rest of the request as it arrives, without storing any of it.
  virtual void DropRequest() = 0;

  // Counts `bytes` as those that the handler stores for the call, in place of what it said before:
  // parsed requests, and answers that wait. Returns false if the tenant or the process then exceeds
  // its limit; the handler should free them and refuse the call.
  virtual bool Hold(int64_t bytes) = 0;
};

// Answers one call. The transport holds a reference until OnClosed() has returned.
class CallHandler {
 public:
  virtual ~CallHandler() = default;

  // Returns the length of the longest message that OnMessage() accepts.
  virtual size_t message_limit() const = 0;

  // The client sent a message. `message` is valid until the method returns.
  virtual void OnMessage(absl::string_view message) = 0;
  // The client announced a message of `length` bytes, more than message_limit(). It is dropped.
  virtual void OnTooLong(size_t length) = 0;
  // The client will send no more messages. Not called after Finish().
  virtual void OnHalfClose() = 0;
  // The call is over: answered, cancelled by the client, past its deadline or disconnected.
  virtual void OnClosed() = 0;
  // The server stops: the call must finish soon.
  virtual void OnDrain() = 0;
};

// Finds the answerers of one loop's calls.
class CallRouter {
 public:
  virtual ~CallRouter() = default;

  // Returns the handler of a new call; it may finish the call at once. Never returns null. `call`
  // is valid until the handler's OnClosed().
  virtual std::shared_ptr<CallHandler> Route(Call* call) = 0;
};

}  // namespace spikeserve
