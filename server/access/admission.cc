#include "server/access/admission.h"

#include <string>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/access/permission.h"

namespace spikeserve {
namespace {

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
  RETURN_IF_ERROR(CheckMayReadStatus((*caller)->role()));
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
