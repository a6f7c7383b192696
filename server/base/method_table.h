// Lists the methods of PolicyService, PolicyAdmin and GRPCInferenceService, with their names in
// metrics and the roles that may call them.
//
// To add a method, add one enumerator and one row. Immutable.
#ifndef SERVER_BASE_METHOD_TABLE_H_
#define SERVER_BASE_METHOD_TABLE_H_

#include <array>
#include <cstddef>

#include "absl/strings/string_view.h"

namespace spikeserve {

// REQUIRES: the same order as kMethodTable.
enum class Method {
  kListPolicies,
  kOpenSession,
  kAct,
  kActBatch,
  kActStream,
  kEndEpisode,
  kGetSession,
  kCloseSession,
  kExplain,
  kLoadPolicy,
  kUnloadPolicy,
  kReloadPolicies,
  kSetDefaultVersion,
  kSetLabel,
  kRemoveLabel,
  kSetTraffic,
  kSetTrafficShares,
  kSetShadow,
  kStartRollout,
  kAbortRollout,
  kListRollouts,
  kListHistory,
  kListSessions,
  kDrain,
  kGetHead,
  kPromoteHead,
  kRollbackHead,
  kPauseLearning,
  kResumeLearning,
  kServerLive,
  kServerReady,
  kModelReady,
  kServerMetadata,
  kModelMetadata,
  kModelInfer,
  kModelStreamInfer,
  kModelConfig,
  kModelStatistics,
  kRepositoryIndex,
  kRepositoryModelLoad,
  kRepositoryModelUnload,
};

// The roles that may call a method.
enum class Access { kAnyRole, kAgentOrOperator, kViewerOrOperator, kOperatorOnly };

struct MethodInfo {
  Method method;
  absl::string_view name;
  Access access;
};

inline constexpr std::array<MethodInfo, 41> kMethodTable = {{
    {Method::kListPolicies, "ListPolicies", Access::kAnyRole},
    {Method::kOpenSession, "OpenSession", Access::kAgentOrOperator},
    {Method::kAct, "Act", Access::kAgentOrOperator},
    {Method::kActBatch, "ActBatch", Access::kAgentOrOperator},
    {Method::kActStream, "ActStream", Access::kAgentOrOperator},
    {Method::kEndEpisode, "EndEpisode", Access::kAgentOrOperator},
    {Method::kGetSession, "GetSession", Access::kAnyRole},
    {Method::kCloseSession, "CloseSession", Access::kAgentOrOperator},
    {Method::kExplain, "Explain", Access::kAnyRole},
    {Method::kLoadPolicy, "LoadPolicy", Access::kOperatorOnly},
    {Method::kUnloadPolicy, "UnloadPolicy", Access::kOperatorOnly},
    {Method::kReloadPolicies, "ReloadPolicies", Access::kOperatorOnly},
    {Method::kSetDefaultVersion, "SetDefaultVersion", Access::kOperatorOnly},
    {Method::kSetLabel, "SetLabel", Access::kOperatorOnly},
    {Method::kRemoveLabel, "RemoveLabel", Access::kOperatorOnly},
    {Method::kSetTraffic, "SetTraffic", Access::kOperatorOnly},
    {Method::kSetTrafficShares, "SetTrafficShares", Access::kOperatorOnly},
    {Method::kSetShadow, "SetShadow", Access::kOperatorOnly},
    {Method::kStartRollout, "StartRollout", Access::kOperatorOnly},
    {Method::kAbortRollout, "AbortRollout", Access::kOperatorOnly},
    {Method::kListRollouts, "ListRollouts", Access::kViewerOrOperator},
    {Method::kListHistory, "ListHistory", Access::kViewerOrOperator},
    {Method::kListSessions, "ListSessions", Access::kViewerOrOperator},
    {Method::kDrain, "Drain", Access::kOperatorOnly},
    {Method::kGetHead, "GetHead", Access::kViewerOrOperator},
    {Method::kPromoteHead, "PromoteHead", Access::kOperatorOnly},
    {Method::kRollbackHead, "RollbackHead", Access::kOperatorOnly},
    {Method::kPauseLearning, "PauseLearning", Access::kOperatorOnly},
    {Method::kResumeLearning, "ResumeLearning", Access::kOperatorOnly},
    {Method::kServerLive, "ServerLive", Access::kAnyRole},
    {Method::kServerReady, "ServerReady", Access::kAnyRole},
    {Method::kModelReady, "ModelReady", Access::kAnyRole},
    {Method::kServerMetadata, "ServerMetadata", Access::kAnyRole},
    {Method::kModelMetadata, "ModelMetadata", Access::kAnyRole},
    {Method::kModelInfer, "ModelInfer", Access::kAgentOrOperator},
    {Method::kModelStreamInfer, "ModelStreamInfer", Access::kAgentOrOperator},
    {Method::kModelConfig, "ModelConfig", Access::kAnyRole},
    {Method::kModelStatistics, "ModelStatistics", Access::kViewerOrOperator},
    {Method::kRepositoryIndex, "RepositoryIndex", Access::kAnyRole},
    {Method::kRepositoryModelLoad, "RepositoryModelLoad", Access::kOperatorOnly},
    {Method::kRepositoryModelUnload, "RepositoryModelUnload", Access::kOperatorOnly},
}};
inline constexpr size_t kMethods = kMethodTable.size();

constexpr const MethodInfo& GetMethodInfo(Method method) {
  return kMethodTable[static_cast<size_t>(method)];
}

static_assert(
    [] {
      for (size_t i = 0; i < kMethods; ++i) {
        if (kMethodTable[i].method != static_cast<Method>(i)) return false;
      }
      return true;
    }(),
    "kMethodTable must list the methods in the order of their enumerators");

}  // namespace spikeserve

#endif  // SERVER_BASE_METHOD_TABLE_H_
