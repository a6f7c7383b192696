// Answers the requests of PolicyAdmin about roll-outs.
//
// Thread-safe.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "server/agent/call_context.h"
#include "server/policies/policy_registry.h"
#include "server/policies/shared_files.h"
#include "server/rollouts/rollout_manager.h"
#include "spikeserve/v1/policy_admin.pb.h"

namespace spikeserve {

class RolloutHandler {
 public:
  // All must outlive this object. `files` compares those of several servers; null: there is one.
  RolloutHandler(const PolicyRegistry* registry, RolloutManager* rollouts, const SharedFiles* files)
      : registry_(registry), rollouts_(rollouts), files_(files) {}

  // Each method fills in `response` and returns OK. On an error it changes nothing and returns the
  // status that policy_admin.proto names.
  absl::Status StartRollout(CallContext& context, const v1::StartRolloutRequest& request,
                            v1::StartRolloutResponse* response) const;
  absl::Status AbortRollout(CallContext& context, const v1::AbortRolloutRequest& request,
                            v1::AbortRolloutResponse* response) const;
  absl::Status ListRollouts(CallContext& context, const v1::ListRolloutsRequest& request,
                            v1::ListRolloutsResponse* response) const;

 private:
  // Fills in the last roll-out of `policy`.
  void Describe(const std::string& policy, v1::Rollout* rollout) const;

  const PolicyRegistry* const registry_;
  RolloutManager* const rollouts_;
  const SharedFiles* const files_;
};

}  // namespace spikeserve
