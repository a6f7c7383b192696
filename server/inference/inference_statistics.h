// Counts the requests of ModelInfer and ModelStreamInfer by policy version, for ModelStatistics.
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "inference/grpc_service.pb.h"

namespace spikeserve {

class InferenceStatistics {
 public:
  // Counts a request that was answered at wall time `when`. `duration` is the time for the request,
  // `compute` the part of it that the decision took.
  void CountSuccess(const std::string& policy, int64_t version, absl::Time when,
                    absl::Duration duration, absl::Duration compute);

  // Counts a request that failed after `duration`.
  void CountFailure(const std::string& policy, int64_t version, absl::Duration duration);

  // Returns the statistics of one version. A decision counts as one inference and as one execution
  // with a batch size of 1.
  inference::ModelStatistics Get(const std::string& policy, int64_t version) const;

 private:
  struct Sum {
    uint64_t count = 0;
    absl::Duration duration;
  };
  struct Sums {
    Sum success;
    Sum failure;
    Sum compute;
    absl::Time last;
  };

  static void Add(absl::Duration duration, Sum* sum);

  mutable absl::Mutex mutex_;
  std::map<std::pair<std::string, int64_t>, Sums> sums_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
