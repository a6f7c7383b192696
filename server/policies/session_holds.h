// The holds that operators have put on sessions, as the settings keep them, and the list of them
// that decisions read.
//
//   const std::shared_ptr<const Hold> hold = registry.settings().holds().Find(session);
#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "core/session/session.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

inline constexpr int64_t kMostHolds = 64;  // of a tenant, or for all of them

// The sessions that meet every condition. A plain value.
struct SessionSelection {
  std::string policy = {};                         // empty: any
  int64_t version = 0;                             // 0: any
  std::optional<std::string> tenant = {};          // absent: any
  std::map<std::string, std::string> labels = {};  // all of them
  std::vector<std::string> session_ids = {};       // one of them; empty: any

  bool Covers(const Session& session) const;
  // Returns INVALID_ARGUMENT, which names the field, for a version without a policy and for more
  // than a hold may name.
  absl::Status Validate() const;

  friend bool operator==(const SessionSelection&, const SessionSelection&) = default;
};

// A plain value.
struct SessionHold {
  Hold hold;
  SessionSelection selection;
  double since = 0.0;  // Unix time in seconds

  friend bool operator==(const SessionHold&, const SessionHold&) = default;
};
nlohmann::json HoldJson(const SessionHold& hold);
absl::Status ReadJson(absl::string_view field, const nlohmann::json& json, SessionHold* hold);

// Thread-safe.
class SessionHolds {
 public:
  using List = std::vector<SessionHold>;

  // Replaces the holds.
  void Set(List holds) ABSL_LOCKS_EXCLUDED(mutex_);
  std::shared_ptr<const List> Get() const ABSL_LOCKS_EXCLUDED(mutex_);
  // Returns how often the holds have changed, so that a session need not be compared with each of
  // them again.
  uint64_t revision() const { return revision_.load(std::memory_order_acquire); }
  // Returns the first hold that covers the session, or null.
  std::shared_ptr<const Hold> Find(const Session& session) const;

 private:
  mutable absl::Mutex mutex_;
  std::shared_ptr<const List> holds_ ABSL_GUARDED_BY(mutex_) = std::make_shared<const List>();
  std::atomic<uint64_t> revision_ = 0;
};

}  // namespace spikeserve
