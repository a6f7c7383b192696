// Writes the decisions of one session to its journal, and reports how many the store has.
//
//   journal->WhenDurable(journal->written(), [](const absl::Status& status) { ... });
//
// A journal belongs to its owner: the process that opened the session or claimed it last, which the
// epoch identifies. If another process claims the session, the store refuses the writes of the
// former owner, whose copy is then lost. An owner whose connection to the store breaks moves its
// journals to new epochs in the same way, so that writes which are still under way on the old
// connection come too late.
//
// Thread-safe. The writing methods are called in the order of the session's changes, under the
// session's lock.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "core/agent/head_log.h"
#include "core/agent/session_listener.h"
#include "core/journal/journal_entry.h"
#include "core/journal/journal_writer.h"
#include "core/session/durability.h"
#include "core/session/session.h"

namespace spikeserve {

class SessionJournal final : public SessionListener,
                             public std::enable_shared_from_this<SessionJournal> {
 public:
  // A snapshot is written after this many decisions, so that a reader folds fewer entries.
  static constexpr size_t kDecisionsPerSnapshot = 16;
  // The largest number of decisions that are answered before they are stored (ASYNC).
  static constexpr uint64_t kMostUnwritten = 256;

  using Done = std::function<void(const absl::Status&)>;

  // Identifies the journal in the store.
  struct Key {
    std::string id;      // of the session
    std::string tenant;  // owner of the session
    uint64_t epoch = 1;  // when this owner began: 1 for a new session; a claim adds to it
    // Names the policy file without which a server cannot continue; empty: any server may try.
    std::string policy_file = "";
    uint64_t claimed_from = 0;   // epoch of the owner before; 0: none
    int64_t ended = 0;           // episodes that the session has ended before this owner
    uint64_t interventions = 0;  // Session::interventions before this owner
    // The id under which the store has the session; empty: `id`. Another one if the store has a
    // session of another tenant under `id` (SecondStoredId).
    std::string stored_as = "";
  };

  // What the store has of the journal, as far as it has acknowledged it.
  struct Stored {
    uint64_t base = 0;   // JournalRecord::base
    size_t records = 0;  // 0: nothing
  };

  // The store has `decisions` of the session, in a journal of `records` records. `writer` must
  // outlive the journal. `is_whole` is false if some of the records are of no use: the journal is
  // then written again. REQUIRES: `durability` is not kNone.
  SessionJournal(Key key, Durability durability, uint64_t decisions, JournalWriter* writer,
                 size_t records = 0, bool is_whole = true);

  const Key& key() const { return key_; }
  // Returns the id under which the store has the session.
  const std::string& stored_as() const { return *stored_as_.load(std::memory_order_acquire); }
  uint64_t epoch() const { return epoch_.load(std::memory_order_acquire); }
  // Returns the epoch of another owner that this one may replace in the store if it has no more
  // than durable_changes(); 0: none.
  uint64_t replaces() const { return replaces_.load(std::memory_order_acquire); }
  // Returns true from OnSetBack() until the store has acknowledged a record.
  bool is_set_back() const { return is_set_back_.load(std::memory_order_acquire); }
  // Returns Session::changes(), as far as the store has acknowledged it. A store that has less has
  // lost something.
  uint64_t durable_changes() const { return durable_changes_.load(std::memory_order_acquire); }
  // Returns true if this owner opened the session, and false if it claimed it.
  bool is_new() const { return is_new_; }
  bool is_sync() const { return is_sync_; }
  // Returns true if another process may have claimed the session unnoticed.
  bool is_shared() const { return writer_.IsShared(); }

  // Returns UNAVAILABLE while the store cannot be reached.
  absl::Status CheckReachable() const { return writer_.CheckReachable(); }
  // Returns UNAVAILABLE if the session must not decide now: while the store cannot be reached
  // (SYNC), or while too much is still to be written (ASYNC).
  absl::Status CheckWritable() const;

  // Writes the snapshot of a new session. The outcome ALREADY_EXISTS makes this copy lost.
  void OnOpen(const Session& session);
  // Writes an entry, or a snapshot in its place: where an entry would not do, and from time to
  // time.
  void OnDecision(const Session& session, const DecisionInputs& inputs) override;
  // Writes a snapshot.
  void OnChange(const Session& session) override;
  // Writes a snapshot. Appends `contribution` to the log of its head when the store has it.
  bool OnEpisodeEnd(const Session& session,
                    const std::shared_ptr<FleetContribution>& contribution) override;
  bool OnVerdict(const Session& session,
                 const std::shared_ptr<FleetContribution>& contribution) override {
    return OnEpisodeEnd(session, contribution);
  }
  // Writes a last snapshot, from which another server continues. Nothing is written after it.
  void OnRelease(const Session& session);
  // Ends the session in the store.
  void OnClose();
  // Makes this copy lost, because nobody was told that the session is open: nothing of it is
  // written from now on. Returns false, and does nothing, if the store has it already.
  bool Withdraw() ABSL_LOCKS_EXCLUDED(mutex_);
  // Asks the store whether this owner still has the journal. WhenDurable() tells the outcome.
  void OnConfirm();
  // Starts the journal again with a snapshot if the store has lost it or a part of it.
  void WriteAgainIfMissing(const Session& session);

  // Returns the position of the last record that was written.
  uint64_t written() const ABSL_LOCKS_EXCLUDED(mutex_);
  // Returns how many decisions of the session the store has, and the ends of how many episodes.
  uint64_t durable_decisions() const { return durable_decisions_.load(std::memory_order_acquire); }
  int64_t durable_episodes() const { return durable_episodes_.load(std::memory_order_acquire); }
  // Returns true if this copy of the session is out of date, because another owner has the journal.
  bool lost() const { return lost_.load(std::memory_order_acquire); }
  // Returns true if the journal is to be written again, by WriteAgainIfMissing().
  bool missing() const { return missing_.load(std::memory_order_acquire); }
  // Makes this copy lost, because it may be out of date: the journal is to be claimed again.
  void Abandon() { lost_.store(true, std::memory_order_release); }

  // Calls `done` once, on any thread: with OK when the store has all records up to `position`, with
  // ALREADY_EXISTS or UNAVAILABLE if this copy is lost, and with UNAVAILABLE if the store cannot be
  // reached. The records are written later even then.
  void WhenDurable(uint64_t position, Done done) ABSL_LOCKS_EXCLUDED(mutex_);

  // Called by the writer.
  // Returns what the store must have.
  Stored stored() const ABSL_LOCKS_EXCLUDED(mutex_);
  // Returns true if a snapshot that is written later, or will be, replaces the record, because the
  // store has lost what comes before it.
  bool IsReplaced(const JournalRecord& record) const {
    return record.position < first_valid_.load(std::memory_order_acquire) &&
           record.kind != JournalRecord::Kind::kClose;
  }
  // The store has the journal under another id than that of the session. Called at most once.
  void OnStoredAs(std::string id) {
    second_id_ = std::move(id);
    stored_as_.store(&second_id_, std::memory_order_release);
  }
  // The journal has another epoch in the store now.
  void OnMoved(uint64_t epoch) { epoch_.store(epoch, std::memory_order_release); }
  // The store has gone back to what another owner has written, which the next snapshot replaces.
  void OnSetBack(uint64_t epoch) {
    replaces_.store(epoch, std::memory_order_release);
    is_set_back_.store(true, std::memory_order_release);
  }
  // The record was written, or refused with ABORTED (this owner has been replaced), ALREADY_EXISTS,
  // or NOT_FOUND (the store has lost the journal or a part of it).
  void OnWritten(const JournalRecord& record, const absl::Status& status)
      ABSL_LOCKS_EXCLUDED(mutex_);
  // The store was asked about the journal: OK (it has stored()), ABORTED or NOT_FOUND, as above.
  void OnChecked(const absl::Status& status) ABSL_LOCKS_EXCLUDED(mutex_);
  // The store cannot be reached, so nobody should wait for the records in the queue.
  void OnUnreachable(const absl::Status& status) ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  struct Waiter {
    uint64_t position;
    Done done;
  };

  // Returns the waiters that the outcome of a record ends.
  std::vector<Waiter> TakeReady(bool all) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Nothing that waits is written before the journal is written again.
  void LoseRecords() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // `session` is what it is with the record; null: as it was.
  void Write(JournalRecord::Kind kind, std::string bytes, const Session* session,
             const std::shared_ptr<FleetContribution>& contribution = nullptr)
      ABSL_LOCKS_EXCLUDED(mutex_);

  const Key key_;
  const bool is_sync_;
  const bool is_new_;
  JournalWriter& writer_;
  std::atomic<uint64_t> durable_decisions_;
  std::atomic<int64_t> durable_episodes_;
  std::atomic<bool> lost_ = false;
  std::atomic<bool> missing_ = false;      // the store has lost the journal or a part of it
  std::atomic<uint64_t> first_valid_ = 0;  // records before this position are replaced
  std::atomic<uint64_t> decisions_;        // with those that are not stored yet
  std::atomic<uint64_t> durable_changes_;
  std::string second_id_;  // set once, before `stored_as_` points to it
  std::atomic<const std::string*> stored_as_;
  std::atomic<uint64_t> epoch_;
  std::atomic<uint64_t> replaces_;
  std::atomic<bool> is_set_back_ = false;
  // Guarded by the session's lock: what the store has, with what waits.
  int64_t episodes_;
  uint64_t changes_;
  size_t records_;
  uint64_t base_ = 0;

  mutable absl::Mutex mutex_;
  uint64_t written_ ABSL_GUARDED_BY(mutex_) = 0;
  uint64_t stored_ ABSL_GUARDED_BY(mutex_) = 0;  // position
  Stored acknowledged_ ABSL_GUARDED_BY(mutex_);
  absl::Status loss_ ABSL_GUARDED_BY(mutex_);  // not OK if the copy is lost
  bool withdrawn_ ABSL_GUARDED_BY(mutex_) = false;
  std::vector<Waiter> waiters_ ABSL_GUARDED_BY(mutex_);
  // Of the last episode, until it is appended to the log of its head: when the record at the
  // position, or a later snapshot, is stored. Null: none.
  std::shared_ptr<FleetContribution> contribution_ ABSL_GUARDED_BY(mutex_);
  uint64_t contribution_position_ ABSL_GUARDED_BY(mutex_) = 0;
};

}  // namespace spikeserve
