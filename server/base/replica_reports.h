// What the servers that share one store report about themselves, for their status pages.
//
//   reports.Set({{.replica = "b7", .written = clock.Now(), .json = "{}"}});
//   for (const ReplicaReport& report : reports.Get()) ...
//
// Thread-safe.
#pragma once

#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"

namespace spikeserve {

struct ReplicaReport {
  std::string replica;
  absl::Duration written;  // time of the reader's clock
  std::string json;
};

class ReplicaReports {
 public:
  // Replaces the reports: the last one of each server, this one and lost ones included.
  void Set(std::vector<ReplicaReport> reports) {
    absl::MutexLock lock(&mutex_);
    reports_ = std::move(reports);
  }
  std::vector<ReplicaReport> Get() const {
    absl::MutexLock lock(&mutex_);
    return reports_;
  }

 private:
  mutable absl::Mutex mutex_;
  std::vector<ReplicaReport> reports_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
