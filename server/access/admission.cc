#include "server/access/admission.h"

#include <string>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/access/role.h"

namespace spikeserve {
namespace {

absl::Status Denied(Role role, absl::string_view allowed) {
  return absl::PermissionDeniedError(
      absl::StrCat("role: expected ", allowed, ", received ", ToString(role)));
}

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

absl::StatusOr<std::shared_ptr<const Credential>> Authenticate(const Authenticator& authenticator,
                                                               absl::string_view authorization) {
  std::string buffer;
  return authenticator.Authenticate(ExtractToken(authorization, &buffer));
}

}  // namespace

absl::StatusOr<std::shared_ptr<const Credential>> Admit(const Authenticator& authenticator,
                                                        absl::string_view authorization,
                                                        const Method& method) {
  const auto caller = Authenticate(authenticator, authorization);
  if (!caller.ok()) return caller;
  RETURN_IF_ERROR(CheckMayCall((*caller)->role(), method));
  return caller;
}

absl::StatusOr<std::shared_ptr<const Credential>> AdmitToPages(const Authenticator& authenticator,
                                                               absl::string_view authorization) {
  const auto caller = Authenticate(authenticator, authorization);
  if (!caller.ok()) return caller;
  if ((*caller)->role() == Role::kAgent) return Denied(Role::kAgent, "viewer or operator");
  return caller;
}

absl::Status AcquireRate(const Credential& caller, const Method& method, absl::Duration now) {
  Tenant& tenant = *caller.tenant();
  return method.cost == Cost::kDecision ? tenant.AcquireDecision(now)
                                        : tenant.AcquireCall(method.cost, now);
}

absl::Status CheckStillAdmitted(const Credential& caller, int64_t request_bytes,
                                int64_t max_message_bytes) {
  RETURN_IF_ERROR(caller.CheckValid());
  return CheckSize(caller, request_bytes, max_message_bytes);
}

absl::Status CheckSize(const Credential& caller, int64_t request_bytes, int64_t max_message_bytes) {
  if (request_bytes > max_message_bytes) {
    return absl::ResourceExhaustedError(absl::StrCat(
        "--max_message_bytes: expected at most ", max_message_bytes, ", received ", request_bytes));
  }
  return caller.tenant()->CheckMessage(request_bytes);
}

}  // namespace spikeserve
