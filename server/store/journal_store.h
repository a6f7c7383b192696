// Writes the journals of all sessions to a backend, on a thread of its own.
//
// Records gather while the thread writes the ones before, and are then written together. Those that
// no answer waits for gather for some milliseconds longer, because most of what a write costs is
// the waking of the thread. Neither a decision nor an event loop waits for the backend: outcomes
// are reported to SessionJournal on this thread. If the backend cannot be reached, the records stay
// in the queue and the thread tries again after a growing delay. If it refuses single records, they
// and the later ones of their sessions are tried again in the same way, and all others are written.
//
// A store may lose what it has acknowledged: when it starts again from older files, or a copy takes
// its place. After each new connection, and now and then, the thread compares the journals of all
// sessions of this server with the store before it writes anything else, and writes the sessions
// again of which the store has less.
//
// Thread-safe, except Stop().
#pragma once

#include <atomic>
#include <cstddef>
#include <functional>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "core/base/steady_wait.h"
#include "core/journal/journal_writer.h"
#include "core/open_sessions/session_store.h"
#include "prometheus/counter.h"
#include "prometheus/gauge.h"
#include "prometheus/histogram.h"
#include "prometheus/registry.h"
#include "server/store/journal_backend.h"

namespace spikeserve {

class JournalStore final : public JournalWriter {
 public:
  // The largest number of bytes that wait to be written.
  static constexpr size_t kMostBacklogBytes = size_t{64} << 20;
  static constexpr absl::Duration kCheckInterval = absl::Minutes(1);

  using Claimed = std::function<void(absl::StatusOr<ClaimedJournal>)>;

  // The journals are compared at least once in `check_interval`, which is less than the time that
  // the store keeps a session. Registers these metrics in `registry`, which must outlive the store,
  // as must `clock`:
  //   spikeserve_store_records_total{outcome}: written or refused
  //   spikeserve_store_acknowledgement_seconds
  //   spikeserve_store_backlog_bytes
  //   spikeserve_store_claims_total{outcome}: claimed or failed
  //   spikeserve_store_fences_total
  //   spikeserve_store_reseeds_total
  //   spikeserve_store_replayed_entries_total
  //   spikeserve_store_reachable
  JournalStore(std::unique_ptr<JournalBackend> backend, const Clock* clock,
               prometheus::Registry* registry, absl::Duration check_interval = kCheckInterval);
  ~JournalStore() override;

  // Writes those of `sessions` again that the store has lost. `sessions` must live until Stop().
  // Calls `before_ends` before the ends of sessions are written. To be called once.
  void Keep(SessionStore* sessions, std::function<void()> before_ends = nullptr) {
    before_ends_ = std::move(before_ends);
    sessions_.store(sessions, std::memory_order_release);
  }

  void Write(JournalRecord record) override;
  void Hurry() override;
  absl::Status CheckReachable() const override;
  absl::Status CheckBacklog() const override;
  absl::Status CheckKeepsRecords() const override;
  bool IsShared() const override { return is_shared_; }
  // As JournalBackend::StoredSessions().
  std::optional<int64_t> StoredSessions() const { return backend_->StoredSessions(); }

  // As JournalBackend::VisitUnowned().
  absl::Status VisitUnowned(const JournalBackend::Visit& visit) const {
    return backend_->VisitUnowned(visit);
  }

  // Claims a session after all records that were written before this call. Calls `claimed` on the
  // thread of the store, with the result of JournalBackend::Claim().
  void Claim(JournalClaim claim, Claimed claimed);

  // Counts the entries that were folded into a snapshot to restore a session.
  void CountReplayed(size_t entries) { replayed_.Increment(static_cast<double>(entries)); }

  // Writes what waits, for at most `timeout`, and ends the thread. Records that are written later
  // are dropped.
  void Stop(absl::Duration timeout);

 private:
  struct ClaimRequest {
    JournalClaim claim;
    Claimed claimed;
  };
  struct Work {
    std::vector<JournalRecord> records;
    std::vector<ClaimRequest> claims;
  };

  void Run();
  // Waits for work, but not long, so that a connection that breaks is noticed without any. Returns
  // nullopt when the store stops and the queue is empty.
  std::optional<Work> Next() ABSL_LOCKS_EXCLUDED(mutex_);
  absl::Duration IdleInterval() const;
  bool HasWork() const ABSL_SHARED_LOCKS_REQUIRED(mutex_);
  bool IsUrgent() const ABSL_SHARED_LOCKS_REQUIRED(mutex_);
  // Connects, and compares the journals if that is due. Returns false if the store is away.
  bool KeepJournals();
  absl::Status CheckJournals();
  // Writes the sessions again of whose journals the store has lost a part.
  void WriteAgain(const std::vector<std::shared_ptr<SessionJournal>>& journals);
  // Moves those of the records [first, end) that a later snapshot replaces to the front, leaves
  // them out, and returns the index of the first other one.
  size_t SkipReplaced(size_t first, size_t end, std::vector<JournalRecord>* records);
  // Returns true if all records were written or refused.
  bool WriteRecords(std::vector<JournalRecord>* records);
  // Takes the records [first, end), except those of sessions in `waiting_`, which get behind them.
  std::vector<JournalRecord> TakeBatch(size_t first, size_t end,
                                       std::vector<JournalRecord>* records);
  // Takes the outcomes of a batch, and puts those that are to be written again into `waiting_`.
  void TakeOutcomes(std::vector<JournalRecord> batch, const std::vector<absl::Status>& outcomes);
  void Refuse(JournalRecord record);
  // Moves what was refused to the front of `records`, if it is to be tried again now. Returns false
  // if it is to be tried later.
  bool TryRefusedAgain(std::vector<JournalRecord>* records);
  // Says whether the store refuses records, and sets when they are tried again if they were now.
  void NoteRefusals(bool tried);
  void Count(const JournalRecord& record, const absl::Status& outcome);
  void RunClaims(std::vector<ClaimRequest> requests);
  // Refuses what waits when the store gives up.
  void DropClaims() ABSL_LOCKS_EXCLUDED(mutex_);
  void SetReachable(const absl::Status& status);
  // Puts the records back to the front of the queue, fails the waits for records that are
  // given up, and waits before the next try. Returns false if the store stops and gives up.
  bool WaitToRetry(std::vector<JournalRecord> records) ABSL_LOCKS_EXCLUDED(mutex_);

  const std::unique_ptr<JournalBackend> backend_;
  const bool is_shared_;
  const Clock* const clock_;
  const absl::Duration check_interval_;
  prometheus::Counter& written_;
  prometheus::Counter& refused_;
  prometheus::Histogram& acknowledgement_;
  prometheus::Gauge& backlog_gauge_;
  prometheus::Counter& claimed_;
  prometheus::Counter& claims_failed_;
  prometheus::Counter& fences_;
  prometheus::Counter& reseeds_;
  prometheus::Counter& replayed_;
  prometheus::Gauge& reachable_gauge_;

  std::atomic<bool> reachable_ = true;
  std::atomic<size_t> backlog_bytes_ = 0;
  std::atomic<bool> may_lose_records_ = false;  // `keeps_records_` is not OK
  std::function<void()> before_ends_;           // set before `sessions_`; null: none
  std::atomic<SessionStore*> sessions_ = nullptr;

  // Of the thread:
  absl::Duration retry_delay_;
  std::vector<JournalRecord> waiting_;                // that the store did not take
  std::set<const SessionJournal*> waiting_journals_;  // their journals
  absl::Status refusal_;                              // of the last one of them
  bool said_refusal_ = false;
  absl::Duration refused_delay_;
  absl::Duration try_refused_at_;
  bool must_check_ = false;    // the store may have lost something
  absl::Duration next_check_;  // time of the clock

  mutable absl::Mutex mutex_;
  SteadyCondition changed_;  // IsUrgent(), `stopping_`, or HasWork() while `idle_`
  Work queue_ ABSL_GUARDED_BY(mutex_);
  bool hurried_ ABSL_GUARDED_BY(mutex_) = false;  // an answer waits for a record in the queue
  bool idle_ ABSL_GUARDED_BY(mutex_) = false;     // the thread waits for any work
  absl::Status keeps_records_ ABSL_GUARDED_BY(mutex_);
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  absl::Duration stop_by_ ABSL_GUARDED_BY(mutex_);
  std::thread thread_;  // declared last, because it uses the members above
};

}  // namespace spikeserve
