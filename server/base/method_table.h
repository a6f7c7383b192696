// Lists the methods of PolicyService, PolicyAdmin and GRPCInferenceService, with their names in
// metrics, the roles that may call them, and what a call costs.
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
  kExportSession,
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

// What one call costs. Says where it is answered, and which rate of the tenant counts it.
enum class Cost {
  kDecision,  // on the loop; each decision counts, see TenantLimits::decisions_per_second
  kLight,     // on the loop, because the work does not grow with the number of versions or sessions
  kListing,   // on a worker: what is listed may be long
  kExplain,   // on a worker: milliseconds of computing
  kOperator,  // on the worker of operators: may read and write files
};
inline constexpr size_t kCosts = 5;

constexpr bool RunsOnLoop(Cost cost) { return cost == Cost::kDecision || cost == Cost::kLight; }

struct MethodInfo {
  Method method;
  absl::string_view name;
  Access access;
  Cost cost;
};

inline constexpr std::array<MethodInfo, 42> kMethodTable = {{
    {Method::kListPolicies, "ListPolicies", Access::kAnyRole, Cost::kListing},
    {Method::kOpenSession, "OpenSession", Access::kAgentOrOperator, Cost::kLight},
    {Method::kAct, "Act", Access::kAgentOrOperator, Cost::kDecision},
    {Method::kActBatch, "ActBatch", Access::kAgentOrOperator, Cost::kDecision},
    {Method::kActStream, "ActStream", Access::kAgentOrOperator, Cost::kDecision},
    {Method::kEndEpisode, "EndEpisode", Access::kAgentOrOperator, Cost::kLight},
    {Method::kGetSession, "GetSession", Access::kAnyRole, Cost::kLight},
    {Method::kCloseSession, "CloseSession", Access::kAgentOrOperator, Cost::kLight},
    {Method::kExplain, "Explain", Access::kAnyRole, Cost::kExplain},
    {Method::kExportSession, "ExportSession", Access::kAgentOrOperator, Cost::kOperator},
    {Method::kLoadPolicy, "LoadPolicy", Access::kOperatorOnly, Cost::kOperator},
    {Method::kUnloadPolicy, "UnloadPolicy", Access::kOperatorOnly, Cost::kOperator},
    {Method::kReloadPolicies, "ReloadPolicies", Access::kOperatorOnly, Cost::kOperator},
    {Method::kSetDefaultVersion, "SetDefaultVersion", Access::kOperatorOnly, Cost::kOperator},
    {Method::kSetLabel, "SetLabel", Access::kOperatorOnly, Cost::kOperator},
    {Method::kRemoveLabel, "RemoveLabel", Access::kOperatorOnly, Cost::kOperator},
    {Method::kSetTraffic, "SetTraffic", Access::kOperatorOnly, Cost::kOperator},
    {Method::kSetTrafficShares, "SetTrafficShares", Access::kOperatorOnly, Cost::kOperator},
    {Method::kSetShadow, "SetShadow", Access::kOperatorOnly, Cost::kOperator},
    {Method::kStartRollout, "StartRollout", Access::kOperatorOnly, Cost::kOperator},
    {Method::kAbortRollout, "AbortRollout", Access::kOperatorOnly, Cost::kOperator},
    {Method::kListRollouts, "ListRollouts", Access::kViewerOrOperator, Cost::kListing},
    {Method::kListHistory, "ListHistory", Access::kViewerOrOperator, Cost::kListing},
    {Method::kListSessions, "ListSessions", Access::kViewerOrOperator, Cost::kListing},
    {Method::kDrain, "Drain", Access::kOperatorOnly, Cost::kOperator},
    {Method::kGetHead, "GetHead", Access::kViewerOrOperator, Cost::kListing},
    {Method::kPromoteHead, "PromoteHead", Access::kOperatorOnly, Cost::kOperator},
    {Method::kRollbackHead, "RollbackHead", Access::kOperatorOnly, Cost::kOperator},
    {Method::kPauseLearning, "PauseLearning", Access::kOperatorOnly, Cost::kOperator},
    {Method::kResumeLearning, "ResumeLearning", Access::kOperatorOnly, Cost::kOperator},
    {Method::kServerLive, "ServerLive", Access::kAnyRole, Cost::kLight},
    {Method::kServerReady, "ServerReady", Access::kAnyRole, Cost::kLight},
    {Method::kModelReady, "ModelReady", Access::kAnyRole, Cost::kLight},
    {Method::kServerMetadata, "ServerMetadata", Access::kAnyRole, Cost::kLight},
    {Method::kModelMetadata, "ModelMetadata", Access::kAnyRole, Cost::kListing},
    {Method::kModelInfer, "ModelInfer", Access::kAgentOrOperator, Cost::kDecision},
    {Method::kModelStreamInfer, "ModelStreamInfer", Access::kAgentOrOperator, Cost::kDecision},
    {Method::kModelConfig, "ModelConfig", Access::kAnyRole, Cost::kLight},
    {Method::kModelStatistics, "ModelStatistics", Access::kViewerOrOperator, Cost::kListing},
    {Method::kRepositoryIndex, "RepositoryIndex", Access::kAnyRole, Cost::kListing},
    {Method::kRepositoryModelLoad, "RepositoryModelLoad", Access::kOperatorOnly, Cost::kOperator},
    {Method::kRepositoryModelUnload, "RepositoryModelUnload", Access::kOperatorOnly,
     Cost::kOperator},
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
