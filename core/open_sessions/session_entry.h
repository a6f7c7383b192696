// A session as a server plays it, and the lock that admits one request at a time.
//
// Thread-safe by the lock.
#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/agent/agent_session.h"
#include "core/agent/episode_recorder.h"
#include "core/agent/robot_link.h"
#include "core/agent/served_policy.h"
#include "core/agent/shadow_session.h"
#include "core/base/clock.h"
#include "core/journal/session_journal.h"
#include "core/open_sessions/session_quota.h"
#include "core/session/usage.h"

namespace spikeserve {

// Ends a label in a LabelText. Labels are UTF-8, which does not contain this byte.
inline constexpr char kLabelEnd = '\xff';

// Returns the labels as "key=value" in lower case, each followed by kLabelEnd.
std::string LabelText(const std::map<std::string, std::string>& labels);

// The label that holds the time between two beats of a robot, in seconds.
inline constexpr char kPeriodLabel[] = "period_seconds";

// The label of a session that was opened for a robot that may send datagrams.
inline constexpr char kDatagramsLabel[] = "datagrams";

// Returns the time between two beats that the labels hold; zero if they hold none.
absl::Duration PeriodOf(const std::map<std::string, std::string>& labels);

// The session's keys for datagrams, which the server makes and which end with the entry.
class SessionDatagrams;

// A session, and the lock that admits one request at a time. Outlives its place in the store as
// long as a request holds a reference.
struct SessionEntry {
  SessionEntry(std::shared_ptr<const ServedPolicy> policy, Session session, const Clock* clock)
      : served(policy),
        tenant(session.options.tenant),
        label_text(LabelText(session.options.labels)),
        period(PeriodOf(session.options.labels)),
        wants_datagrams(session.options.labels.contains(kDatagramsLabel)),
        was_taken(session.seat.has_value()),
        agent(std::move(policy), std::move(session), clock),
        robot(period) {}

  const std::shared_ptr<const ServedPolicy> served;
  const std::string tenant;      // owner of the session
  const std::string label_text;  // what filters search for labels, without the lock
  const absl::Duration period;   // between two beats of the robot; zero: unknown
  const bool wants_datagrams;    // its robot may send them
  // An operator has, or once had, control; the others are counted without their locks.
  std::atomic<bool> was_taken;
  // Null: none. Set before the entry is shared.
  std::shared_ptr<ShadowSession> shadow;
  std::shared_ptr<SessionQuota> quota;
  std::shared_ptr<SessionJournal> journal;  // null: the session is not stored
  absl::Mutex mutex;
  std::shared_ptr<EpisodeRecorder> recorder ABSL_GUARDED_BY(mutex);  // null: not recorded
  AgentSession agent ABSL_GUARDED_BY(mutex);
  // Steps that the shadow has not processed yet; null: there is none.
  std::shared_ptr<ShadowSteps> shadow_steps ABSL_GUARDED_BY(mutex);
  RobotLink robot ABSL_GUARDED_BY(mutex);
  std::shared_ptr<SessionDatagrams> datagrams ABSL_GUARDED_BY(mutex);  // null: none
  // Of the holds that `agent` was compared with.
  uint64_t holds_revision ABSL_GUARDED_BY(mutex) = 0;
  SessionUsage usage ABSL_GUARDED_BY(mutex);
};

}  // namespace spikeserve
