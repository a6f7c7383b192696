#include "server/policy_admin_handler.h"

#include <algorithm>
#include <cstdint>
#include <vector>

#include "absl/strings/str_cat.h"
#include "server/session_info.h"

namespace spikeserve {
namespace {

constexpr int32_t kDefaultPageSize = 100;
constexpr int32_t kLargestPageSize = 1000;

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
