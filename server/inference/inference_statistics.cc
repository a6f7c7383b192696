#include "server/inference/inference_statistics.h"

#include "absl/strings/str_cat.h"

namespace spikeserve {

void InferenceStatistics::Add(absl::Duration duration, Sum* sum) {
  ++sum->count;
  sum->duration += duration;
}

void InferenceStatistics::CountSuccess(const std::string& policy, int64_t version, absl::Time when,
                                       absl::Duration duration, absl::Duration compute) {
  absl::MutexLock lock(&mutex_);
  Sums& sums = sums_[{policy, version}];
  Add(duration, &sums.success);
  Add(compute, &sums.compute);
  sums.last = when;
}

void InferenceStatistics::CountFailure(const std::string& policy, int64_t version,
                                       absl::Duration duration) {
  absl::MutexLock lock(&mutex_);
  Add(duration, &sums_[{policy, version}].failure);
}

inference::ModelStatistics InferenceStatistics::Get(const std::string& policy,
                                                    int64_t version) const {
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

}  // namespace spikeserve
