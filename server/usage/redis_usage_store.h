// Keeps the ledger of all servers that share a Redis, in keys of one slot of a Cluster:
//
// - us:{u}:p, a hash: of each process, the number of its last batch and when that was.
// - us:{u}:s, a hash: of each session, when it was booked last, and the totals that were.
// - us:{u}:o<hour>, a hash: of each series, what it has used in an hour that is open; and under the
//   empty field, the number of batches.
// - us:{u}:t<month>, a hash: of each tenant, what it has used in a month.
// - us:{u}:b, a hash: the other parts, packed; `<part>:r` has the revision of a part.
// - us:{u}:h, a set: the parts that are open.
#pragma once

#include <functional>
#include <initializer_list>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "core/store/redis_client.h"
#include "core/store/redis_options.h"
#include "server/usage/usage_store.h"

namespace spikeserve {

// Thread-safe. Methods block for at most a few RedisOptions::timeout.
class RedisUsageStore final : public UsageStore {
 public:
  explicit RedisUsageStore(RedisOptions options) : options_(std::move(options)) {}

  absl::Status Book(const UsageBatch& batch) override;
  absl::StatusOr<std::map<std::string, UsageCounts>> MonthOf(absl::Time time) override;
  absl::StatusOr<std::vector<std::string>> Parts() override;
  absl::StatusOr<UsagePart> Read(const std::string& part) override;
  absl::Status Replace(const UsagePart& source, const UsagePart& target,
                       const std::string& packed) override;
  absl::Status Forget(absl::Time time) override;

 private:
  absl::StatusOr<RedisReply> Run(bool writes, std::initializer_list<absl::string_view> arguments)
      ABSL_LOCKS_EXCLUDED(mutex_);
  absl::StatusOr<std::vector<std::pair<std::string, std::string>>> ReadHash(const std::string& key);

  const RedisOptions options_;
  absl::Mutex mutex_;
  std::unique_ptr<RedisClient> client_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
