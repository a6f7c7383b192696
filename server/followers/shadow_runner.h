// Replays the decisions of sessions on their shadow policies, on a thread of low priority, so that
// no answer waits for a shadow. If the queue is full, steps are dropped and counted.
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <deque>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "core/agent/shadow_session.h"
#include "prometheus/counter.h"
#include "prometheus/family.h"
#include "prometheus/registry.h"

namespace spikeserve {

class ShadowRunner {
 public:
  static constexpr size_t kLongestQueue = 10'000;  // steps

  // Registers these counters in `registry`, which must outlive the runner:
  //   spikeserve_shadow_decisions_total{policy,version,shadow_version,agreement}: agree or differ
  //   spikeserve_shadow_spikes_total{policy,version,shadow_version,side}: served or shadow
  //   spikeserve_shadow_dropped_total{policy,version,shadow_version}
  explicit ShadowRunner(prometheus::Registry& registry);

  // Blocks until the current step is finished. Drops the steps that are still queued.
  ~ShadowRunner();
  ShadowRunner(const ShadowRunner&) = delete;
  ShadowRunner& operator=(const ShadowRunner&) = delete;

  // Queues the next steps, in their order, of a session that `served_version` serves.
  void Submit(const std::shared_ptr<ShadowSession>& shadow, int64_t served_version,
              std::vector<ShadowStep> steps);

 private:
  struct Job {
    std::shared_ptr<ShadowSession> shadow;
    int64_t served_version;
    ShadowStep step;
  };

  void Run();
  void Play(const Job& job);
  void CountDropped(const ShadowSession& shadow, int64_t served_version, size_t steps);

  prometheus::Family<prometheus::Counter>& decisions_;
  prometheus::Family<prometheus::Counter>& spikes_;
  prometheus::Family<prometheus::Counter>& dropped_;

  absl::Mutex mutex_;
  std::deque<Job> queue_ ABSL_GUARDED_BY(mutex_);
  bool stop_ ABSL_GUARDED_BY(mutex_) = false;
  std::thread thread_;  // declared last, because it uses the members above
};

}  // namespace spikeserve
