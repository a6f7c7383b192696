// Records the changes of operators, and those of the server itself, in the audit log, with the
// state before and after them.
//
// Thread-safe.
#pragma once

#include <google/protobuf/message.h>

#include <string>

#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "core/open_sessions/session_store.h"
#include "server/admin/audit_log.h"
#include "server/agent/call_context.h"
#include "server/base/method.h"
#include "server/policies/policy_registry.h"
#include "server/rollouts/rollout_manager.h"

namespace spikeserve {

class Audit {
 public:
  // All must outlive this object. `allow_unrecorded`: calls are run, too, if they cannot be
  // recorded.
  Audit(AuditLog* log, const PolicyRegistry* registry, const SessionStore* store,
        bool allow_unrecorded)
      : log_(log), registry_(registry), store_(store), allow_unrecorded_(allow_unrecorded) {}

  // Runs `change`, the call of an operator or one that an agent has to answer for, and records it
  // with its outcome, which is returned. If it could not be recorded, it is not run, and
  // UNAVAILABLE is returned, unless changes that are not recorded are allowed.
  absl::Status RunAndRecord(const Method& method, const CallContext& context,
                            const google::protobuf::Message& request,
                            absl::FunctionRef<absl::Status()> change) const;

  // Records a change that a roll-out made.
  void Record(const RolloutManager::Change& change) const;

 private:
  // Returns, as JSON, the state that `request` may change: of the policy that it names, or, if it
  // names none, of all policies and of the server. Without holds of other tenants, because all who
  // may see what `tenant` does read it.
  std::string StateOf(const google::protobuf::Message& request, const std::string& tenant) const;

  AuditLog* const log_;
  const PolicyRegistry* const registry_;
  const SessionStore* const store_;
  const bool allow_unrecorded_;
};

}  // namespace spikeserve
