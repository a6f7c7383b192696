// Records the changes of operators, and those of the server itself, in the audit log, with the
// state before and after them.
//
// Thread-safe.
#ifndef SERVER_ADMIN_AUDIT_H_
#define SERVER_ADMIN_AUDIT_H_

#include <google/protobuf/message.h>

#include <string>

#include "absl/status/status.h"
#include "core/session/session_store.h"
#include "server/access/authenticator.h"
#include "server/base/audit_log.h"
#include "server/base/method_table.h"
#include "server/policies/policy_registry.h"
#include "server/rollouts/rollout_manager.h"

namespace spikeserve {

class Audit {
 public:
  // All must outlive this object.
  Audit(AuditLog* log, const PolicyRegistry* registry, const SessionStore* store)
      : log_(log), registry_(registry), store_(store) {}

  // Returns, as JSON, the state that `request` may change: of the policy that it names, or, if it
  // names none, of all policies and of the server.
  std::string StateBefore(const google::protobuf::Message& request) const;

  // Records a call that ended with `outcome`. `before` is the result of StateBefore.
  void Record(Method method, const Credential& caller, const Peer& peer,
              const google::protobuf::Message& request, std::string before,
              const absl::Status& outcome) const;

  // Records a change that a roll-out made.
  void Record(const RolloutManager::Change& change) const;

 private:
  AuditLog* const log_;
  const PolicyRegistry* const registry_;
  const SessionStore* const store_;
};

}  // namespace spikeserve

#endif  // SERVER_ADMIN_AUDIT_H_
