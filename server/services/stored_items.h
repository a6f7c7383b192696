// The sessions that a call names, and their parts of its answer, for calls of sessions that are
// kept in a store. The functions exist for every call; those of a batch are overloads.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_SERVICES_STORED_ITEMS_H_
#define SERVER_SERVICES_STORED_ITEMS_H_

#include <map>
#include <string>
#include <type_traits>
#include <vector>

#include "absl/status/status.h"
#include "core/session/agent_session.h"
#include "core/session/head_log.h"
#include "server/agent/convert.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// Is satisfied by requests that name one session.
template <typename Request>
concept NamesSession = requires(const Request& request) {
  request.session_id();
};

// True for calls that only read a session: it stays with its owner.
template <typename Request>
inline constexpr bool kOnlyReads = std::is_same_v<Request, v1::GetSessionRequest>;

// Fills in the answer to a call that only reads.
inline void AnswerWith(const AgentSession& session, const v1::GetSessionRequest& request,
                       v1::GetSessionResponse* response) {
  *response = ToProto(session, request.include_head_delta());
}

// Returns the sessions that the call did not find, or could not open because the store has them.
template <typename Request, typename Response>
std::vector<std::string> MissingSessions(const Request& request, const Response& /*response*/,
                                         const absl::Status& status) {
  if constexpr (NamesSession<Request>) {
    if (absl::IsNotFound(status) || absl::IsAlreadyExists(status)) return {request.session_id()};
  }
  return {};
}
inline std::vector<std::string> MissingSessions(const v1::ActBatchRequest& request,
                                                const v1::ActBatchResponse& response,
                                                const absl::Status& /*status*/) {
  std::vector<std::string> missing;
  for (int i = 0; i < response.results_size(); ++i) {
    if (response.results(i).code() == static_cast<int>(absl::StatusCode::kNotFound)) {
      missing.push_back(request.requests(i).session_id());
    }
  }
  return missing;
}

// Replaces the result of an item by an error.
template <typename Response>
void FailItem(int /*item*/, const absl::Status& /*status*/, Response* /*response*/) {}
inline void FailItem(int item, const absl::Status& status, v1::ActBatchResponse* response) {
  ErrorToProto(status, response->mutable_results(item));
}

// Completes the summary of an episode with the outcome of its contribution to the head of a fleet.
template <typename Response>
void TakeMerged(const FleetContribution& /*contribution*/, Response* /*response*/) {}
inline void TakeMerged(const FleetContribution& contribution, v1::EndEpisodeResponse* response) {
  const auto merged = contribution.merged();
  if (merged.has_value()) *response->mutable_learning() = ToProto(*merged);
}

// Replaces the results of items that found no session by the reasons why the session could not be
// taken over, by session.
template <typename Request, typename Response>
void ExplainMissing(const Request& /*request*/,
                    const std::map<std::string, absl::Status>& /*reasons*/,
                    Response* /*response*/) {}
inline void ExplainMissing(const v1::ActBatchRequest& request,
                           const std::map<std::string, absl::Status>& reasons,
                           v1::ActBatchResponse* response) {
  if (reasons.empty()) return;
  for (int i = 0; i < response->results_size(); ++i) {
    const auto reason = reasons.find(request.requests(i).session_id());
    const bool missing =
        response->results(i).code() == static_cast<int>(absl::StatusCode::kNotFound);
    if (missing && reason != reasons.end()) FailItem(i, reason->second, response);
  }
}

}  // namespace spikeserve

#endif  // SERVER_SERVICES_STORED_ITEMS_H_
