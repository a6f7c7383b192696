#include "server/policy_admin_handler.h"

#include <algorithm>
#include <cstdint>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"

namespace spikeserve {
namespace {

constexpr int32_t kDefaultPageSize = 100;
constexpr int32_t kLargestPageSize = 1000;

void ToProto(const ListedSession& listed, v1::SessionInfo* info) {
  absl::MutexLock lock(&listed.entry->mutex);
  const Session& session = listed.entry->agent.session();
  info->set_session_id(listed.id);
  info->set_policy(session.options.policy);
  info->set_version(session.options.version);
  info->set_episode(session.episode);
  info->set_step(session.step);
  info->set_episode_return(session.episode_return);
  info->set_decisions(session.decisions);
  info->set_spikes(session.spikes);
  info->set_energy_joules(session.energy_joules);
  info->set_idle_seconds(absl::ToDoubleSeconds(listed.idle));
  info->set_learning(session.options.learning.has_value());
  info->mutable_labels()->insert(session.options.labels.begin(), session.options.labels.end());
}

}  // namespace

absl::Status PolicyAdminHandler::ListSessions(const v1::ListSessionsRequest& request,
                                              v1::ListSessionsResponse* response) const {
  if (request.page_size() < 0 || request.page_size() > kLargestPageSize) {
    return absl::InvalidArgumentError(absl::StrCat("page_size: expected 0 to ", kLargestPageSize,
                                                   ", received ", request.page_size()));
  }
  const std::vector<ListedSession> sessions = store_->List([&](const ServedPolicy& served) {
    return (request.policy().empty() || request.policy() == served.name) &&
           (request.version() == 0 || request.version() == served.version);
  });
  // A page's token is the id of its last session, so pages stay in order while sessions come and
  // go.
  const auto first = std::find_if(sessions.begin(), sessions.end(), [&](const auto& session) {
    return session.id > request.page_token();
  });
  const auto size = request.page_size() == 0 ? kDefaultPageSize : request.page_size();
  const auto last = first + std::min<std::ptrdiff_t>(size, sessions.end() - first);
  for (auto it = first; it != last; ++it) ToProto(*it, response->add_sessions());
  if (last != sessions.end()) response->set_next_page_token((last - 1)->id);
  response->set_open_sessions(store_->size());
  return absl::OkStatus();
}

}  // namespace spikeserve
