// Tracks the calls in flight, so that a server can stop without interrupting one.
//
//   if (!calls.Begin()) return DrainingError();  // and call End() later
//   ...
//   calls.Drain();
//   calls.WaitUntilIdle(absl::Seconds(30));
//
// Thread-safe. Lock order: the tracker calls no stream while it holds its own mutex.
#ifndef SERVER_RPC_CALL_TRACKER_H_
#define SERVER_RPC_CALL_TRACKER_H_

#include <cstdint>
#include <memory>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"

namespace spikeserve {

// Returns the status of calls that arrive while the server drains: UNAVAILABLE.
absl::Status DrainingError();

class CallTracker {
 public:
  // A call without an end of its own, which the server has to end when it drains.
  class Stream {
   public:
    virtual ~Stream() = default;
    virtual void Drain() = 0;
  };

  // Registers a call. Returns false while draining: the caller must then refuse the call. Each
  // Begin() needs one End(), and each BeginStream() one EndStream(), also for refused calls.
  bool Begin();
  bool BeginStream(const std::shared_ptr<Stream>& stream);
  void End();
  void EndStream(const Stream* stream);

  // Refuses calls from now on, and calls Drain() of the open streams.
  void Drain();

  // Blocks until no call is in flight. Returns false if `timeout` passes first.
  bool WaitUntilIdle(absl::Duration timeout);

 private:
  absl::Mutex mutex_;
  bool draining_ ABSL_GUARDED_BY(mutex_) = false;
  int64_t calls_ ABSL_GUARDED_BY(mutex_) = 0;
  absl::flat_hash_map<const Stream*, std::weak_ptr<Stream>> streams_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve

#endif  // SERVER_RPC_CALL_TRACKER_H_
