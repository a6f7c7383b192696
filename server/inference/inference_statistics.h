// Counts the requests of ModelInfer and ModelStreamInfer by policy version, for ModelStatistics.
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "inference/grpc_service.pb.h"

namespace spikeserve {

class InferenceStatistics {
 public:
  // Counts a request that was answered at wall time `when`. `duration` is the time for the request,
  // `compute` the part of it that the decision took.
  void CountSuccess(const std::string& policy, int64_t version, absl::Time when,
                    absl::Duration duration, absl::Duration compute) {
    absl::MutexLock lock(&mutex_);
    Sums& sums = sums_[{policy, version}];
    Add(duration, &sums.success);
    Add(compute, &sums.compute);
    sums.last = when;
  }

  // Counts a request that failed after `duration`.
  void CountFailure(const std::string& policy, int64_t version, absl::Duration duration) {
    absl::MutexLock lock(&mutex_);
    Add(duration, &sums_[{policy, version}].failure);
  }

  // Returns the statistics of one version. A decision counts as one inference and as one execution
  // with a batch size of 1.
  inference::ModelStatistics Get(const std::string& policy, int64_t version) const {
    Sums sums;
    {
      absl::MutexLock lock(&mutex_);
      const auto it = sums_.find({policy, version});
      if (it != sums_.end()) sums = it->second;
    }
    const auto write = [](const Sum& sum, inference::StatisticDuration* duration) {
      duration->set_count(sum.count);
      duration->set_ns(static_cast<uint64_t>(absl::ToInt64Nanoseconds(sum.duration)));
    };
    inference::ModelStatistics statistics;
    statistics.set_name(policy);
    statistics.set_version(absl::StrCat(version));
    statistics.set_inference_count(sums.success.count);
    statistics.set_execution_count(sums.success.count);
    write(sums.success, statistics.mutable_inference_stats()->mutable_success());
    write(sums.failure, statistics.mutable_inference_stats()->mutable_fail());
    write(sums.compute, statistics.mutable_inference_stats()->mutable_compute_infer());
    if (sums.success.count > 0) {
      statistics.set_last_inference(static_cast<uint64_t>(absl::ToUnixMillis(sums.last)));
      auto* batch = statistics.add_batch_stats();
      batch->set_batch_size(1);
      write(sums.compute, batch->mutable_compute_infer());
    }
    return statistics;
  }

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

  static void Add(absl::Duration duration, Sum* sum) {
    ++sum->count;
    sum->duration += duration;
  }

  mutable absl::Mutex mutex_;
  std::map<std::pair<std::string, int64_t>, Sums> sums_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
