// Somebody who shares the server with others: the owner of sessions, with limits of their own.
//
// Thread-safe; a decision takes no lock.
#ifndef SERVER_ACCESS_TENANT_H_
#define SERVER_ACCESS_TENANT_H_

#include <atomic>
#include <cstdint>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "core/session/session_quota.h"
#include "server/access/rate_limit.h"
#include "server/access/refusal_pacer.h"

namespace spikeserve {

// 0: no limit but the server's own.
struct TenantLimits {
  int64_t max_sessions = 0;           // open at a time
  double decisions_per_second = 0.0;  // in the long run; a second's worth may come at once
  int64_t max_message_bytes = 0;      // of one request

  // INVALID_ARGUMENT names the field, what was expected and what came.
  absl::Status Validate() const;
};

class Tenant final : public SessionQuota {
 public:
  explicit Tenant(std::string name) : name_(std::move(name)) {}

  const std::string& name() const { return name_; }

  // Sessions that are open already stay so.
  void SetLimits(const TenantLimits& limits);

  absl::Status Acquire() override;
  void Release() override { sessions_.fetch_sub(1, std::memory_order_relaxed); }

  // RESOURCE_EXHAUSTED, with google.rpc.RetryInfo, where there were too many decisions before
  // `now`, which is on any clock that never goes back, always the same one.
  absl::Status AcquireDecision(absl::Duration now);

  // RESOURCE_EXHAUSTED for a request that is too long.
  absl::Status CheckMessage(int64_t bytes) const;

  // Of everybody who comes with a token of this tenant.
  RefusalPacer& refusals() { return refusals_; }

 private:
  const std::string name_;
  RateLimit decisions_;
  RefusalPacer refusals_;
  std::atomic<int64_t> max_sessions_ = 0;
  std::atomic<int64_t> max_message_bytes_ = 0;
  std::atomic<int64_t> sessions_ = 0;
};

}  // namespace spikeserve

#endif  // SERVER_ACCESS_TENANT_H_
