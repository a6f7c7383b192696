#include "server/access/role.h"

#include <array>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

constexpr std::array<std::string_view, 3> kNames = {"agent", "viewer", "operator"};

absl::Status Denied(Role role, absl::string_view allowed) {
  const std::string_view name = ToString(role);
  return absl::PermissionDeniedError(absl::StrCat("role: expected ", allowed, ", the token's is ",
                                                  absl::string_view(name.data(), name.size())));
}

}  // namespace

std::string_view ToString(Role role) { return kNames[static_cast<size_t>(role)]; }

bool FromString(std::string_view name, Role* role) {
  for (size_t i = 0; i < kNames.size(); ++i) {
    if (name != kNames[i]) continue;
    *role = static_cast<Role>(i);
    return true;
  }
  return false;
}

absl::Status CheckMayCall(Role role, Method method) {
  if (role == Role::kOperator) return absl::OkStatus();
  switch (method) {
    case Method::kListPolicies:
    case Method::kServerLive:
    case Method::kServerReady:
    case Method::kModelReady:
    case Method::kServerMetadata:
    case Method::kModelMetadata:
    case Method::kModelConfig:
    case Method::kRepositoryIndex:
    case Method::kGetSession:  // of a session that the caller may see
    case Method::kExplain:
      return absl::OkStatus();
    case Method::kOpenSession:
    case Method::kAct:
    case Method::kActBatch:
    case Method::kActStream:
    case Method::kEndEpisode:
    case Method::kCloseSession:
    case Method::kModelInfer:
    case Method::kModelStreamInfer:
      return role == Role::kAgent ? absl::OkStatus() : Denied(role, "agent or operator");
    case Method::kListSessions:
    case Method::kGetHead:
    case Method::kModelStatistics:
      return role == Role::kViewer ? absl::OkStatus() : Denied(role, "viewer or operator");
    default:  // whatever is new stays the operator's until it is listed above
      return Denied(role, "operator");
  }
}

absl::Status CheckMayWatch(Role role) {
  return role == Role::kAgent ? Denied(role, "viewer or operator") : absl::OkStatus();
}

}  // namespace spikeserve
