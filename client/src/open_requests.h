// The requests of a stream that have no answer. Times are those of SteadyNow().
//
// Not thread-safe.
#pragma once

#include <cstddef>
#include <deque>
#include <map>
#include <optional>
#include <string>
#include <unordered_map>
#include <utility>

#include "absl/time/time.h"
#include "client/src/steady_time.h"
#include "spikeserve/remote_session.h"
#include "spikeserve/retry.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

struct OpenRequest {
  RemoteSession* session;  // null: it was sent without one
  v1::ActRequest request;
  std::optional<RetrySchedule> schedule;  // since its first failure
  int failures = 0;                       // how often the server could not answer it now
};

class OpenRequests {
 public:
  bool empty() const { return open_.empty(); }
  bool Has(const std::string& session_id) const { return open_.count(session_id) > 0; }

  // Adds a request that is sent now.
  void Add(OpenRequest request) {
    if (open_.empty()) waits_since_ = SteadyNow();
    const std::string& id = request.request.session_id();
    open_[id].push_back(std::move(request));
  }

  // Removes and returns the oldest request of a session, for its reply; nothing if there is none.
  std::optional<OpenRequest> Take(const std::string& session_id) {
    const auto found = open_.find(session_id);
    if (found == open_.end()) return std::nullopt;
    waits_since_ = SteadyNow();
    std::optional<OpenRequest> request(std::move(found->second.front()));
    found->second.pop_front();
    if (found->second.empty()) open_.erase(found);
    return request;
  }

  // Adds a request that will be sent again at `due`. REQUIRES: it is the only one of its session.
  void Postpone(OpenRequest request, absl::Duration due) {
    due_.emplace(due, request.request.session_id());
    Add(std::move(request));
  }

  // Calls `send` with each postponed request that is due, which counts as under way again.
  template <typename Send>
  void SendDue(absl::Duration now, Send send) {
    while (!due_.empty() && due_.begin()->first <= now) {
      send(open_.at(due_.begin()->second).front().request);
      due_.erase(due_.begin());
      waits_since_ = now;
    }
  }

  // Calls `send` with every request, all of which count as under way.
  template <typename Send>
  void SendAll(Send send) {
    due_.clear();
    waits_since_ = SteadyNow();
    for (const auto& [id, requests] : open_) {
      for (const OpenRequest& request : requests) send(request.request);
    }
  }

  // Returns the time of the next postponed request.
  absl::Duration next_due() const {
    return due_.empty() ? absl::InfiniteDuration() : due_.begin()->first;
  }
  // Returns since when requests are under way without any reply; InfiniteDuration if none is.
  absl::Duration waits_since() const {
    return open_.size() == due_.size() ? absl::InfiniteDuration() : waits_since_;
  }

  void Clear() {
    open_.clear();
    due_.clear();
  }

 private:
  std::unordered_map<std::string, std::deque<OpenRequest>> open_;  // by session id
  std::multimap<absl::Duration, std::string> due_;                 // postponed ones: session ids
  absl::Duration waits_since_;
};

}  // namespace spikeserve
