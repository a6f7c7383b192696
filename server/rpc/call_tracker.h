// The calls in flight, so that a server can stop without cutting one off.
//
// Thread-safe. A stream's own mutex is never taken while the tracker's is held.
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

// What a call that comes while the server drains is answered with: UNAVAILABLE.
absl::Status DrainingError();

class CallTracker {
 public:
  // A call that its client may keep open for ever, so that it has to be told to end.
  class Stream {
   public:
    virtual ~Stream() = default;
    virtual void Drain() = 0;
  };

  // Every call begins and ends once. Returns false while draining: the call is to be refused, and
  // still to end.
  bool Begin();
  bool BeginStream(const std::shared_ptr<Stream>& stream);
  void End();
  void EndStream(const Stream* stream);

  // From here on calls are refused; tells the open streams.
  void Drain();

  // Waits until no call is in flight; false if `timeout` passes first.
  bool WaitUntilIdle(absl::Duration timeout);

 private:
  absl::Mutex mutex_;
  bool draining_ ABSL_GUARDED_BY(mutex_) = false;
  int64_t calls_ ABSL_GUARDED_BY(mutex_) = 0;
  absl::flat_hash_map<const Stream*, std::weak_ptr<Stream>> streams_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve

#endif  // SERVER_RPC_CALL_TRACKER_H_
