#include "server/access/permission.h"

#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"

namespace spikeserve {
namespace {

absl::Status Denied(Role role, absl::string_view allowed) {
  return absl::PermissionDeniedError(
      absl::StrCat("role: expected ", allowed, ", received ", ToString(role)));
}

}  // namespace

absl::Status CheckMayCall(Role role, const Method& method) {
  if (role == Role::kOperator) return absl::OkStatus();
  switch (method.access) {
    case Access::kAnyRole:
      return absl::OkStatus();
    case Access::kAgentOrOperator:
      return role == Role::kAgent ? absl::OkStatus() : Denied(role, "agent or operator");
    case Access::kViewerOrOperator:
      return role == Role::kViewer ? absl::OkStatus() : Denied(role, "viewer or operator");
    case Access::kOperatorOnly:
      break;
  }
  return Denied(role, "operator");
}

absl::Status CheckMayReadStatus(Role role) {
  return role == Role::kAgent ? Denied(role, "viewer or operator") : absl::OkStatus();
}

}  // namespace spikeserve
