// Answers GetUsage, on the wire and for the status page.
//
// Thread-safe.
#pragma once

#include "absl/status/status.h"
#include "server/agent/call_context.h"
#include "server/usage/ledger.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

class UsageHandler {
 public:
  // `ledger` must outlive the handler.
  explicit UsageHandler(const Ledger* ledger) : ledger_(*ledger) {}

  // Returns the status that policy_admin.proto names.
  absl::Status GetUsage(CallContext& context, const v1::GetUsageRequest& request,
                        v1::GetUsageResponse* response) const;

 private:
  const Ledger& ledger_;
};

}  // namespace spikeserve
