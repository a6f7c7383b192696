#include "core/session/session_journal.h"

#include <utility>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

absl::Status ReplacedError() {
  return absl::UnavailableError(
      "session_id: expected a session of this server, received one that another server has taken "
      "over; try again");
}

absl::Status MissingError() {
  return absl::UnavailableError(
      "session store: has lost the session, which is written again; try again");
}

}  // namespace

SessionJournal::SessionJournal(Key key, Durability durability, uint64_t decisions,
                               JournalWriter* writer, size_t records)
    : key_(std::move(key)),
      is_sync_(durability == Durability::kSync),
      writer_(*writer),
      durable_decisions_(decisions),
      decisions_(decisions),
      epoch_(key_.epoch),
      records_(records) {}

absl::Status SessionJournal::CheckWritable() const {
  if (is_sync_) {
    if (auto status = writer_.CheckReachable(); !status.ok()) return status;
  } else if (decisions_.load(std::memory_order_relaxed) - durable_decisions() >= kMostUnwritten) {
    return absl::UnavailableError(
        absl::StrCat("session store: expected fewer than ", kMostUnwritten,
                     " decisions of the session that are not stored yet; try again"));
  }
  return writer_.CheckBacklog();
}

void SessionJournal::OnOpen(const Session& session) {
  Write(JournalRecord::Kind::kOpen, SerializeSession(session), session.decisions);
}

void SessionJournal::OnDecision(const Session& session, const JournalEntryView& entry) {
  if (records_ < kDecisionsPerSnapshot) {
    Write(JournalRecord::Kind::kEntry, SerializeEntry(entry), session.decisions);
  } else {
    Write(JournalRecord::Kind::kSnapshot, SerializeSession(session), session.decisions);
  }
}

void SessionJournal::OnEpisodeEnd(const Session& session,
                                  std::shared_ptr<FleetContribution> contribution) {
  Write(JournalRecord::Kind::kSnapshot, SerializeSession(session), session.decisions,
        std::move(contribution));
}

void SessionJournal::OnRelease(const Session& session) {
  if (lost()) return;
  Write(JournalRecord::Kind::kRelease, SerializeSession(session), session.decisions);
}

void SessionJournal::OnClose() {
  if (!lost()) Write(JournalRecord::Kind::kClose, "", decisions_.load(std::memory_order_relaxed));
}

void SessionJournal::WriteAgainIfMissing(const Session& session) {
  if (!missing_.exchange(false, std::memory_order_acq_rel)) return;
  OnOpen(session);
}

void SessionJournal::Write(JournalRecord::Kind kind, std::string bytes, uint64_t decisions,
                           std::shared_ptr<FleetContribution> contribution) {
  decisions_.store(decisions, std::memory_order_relaxed);
  // All others are snapshots, which replace what was there.
  records_ = kind == JournalRecord::Kind::kEntry ? records_ + 1 : 1;
  JournalRecord record = {.kind = kind,
                          .bytes = std::move(bytes),
                          .decisions = decisions,
                          .records = records_,
                          .journal = shared_from_this(),
                          .contribution = std::move(contribution)};
  // The lock makes the order of the queue that of the positions.
  absl::MutexLock lock(&mutex_);
  if (kind == JournalRecord::Kind::kOpen) record.contribution = std::exchange(kept_, nullptr);
  record.position = ++written_;
  writer_.Write(std::move(record));
}

uint64_t SessionJournal::written() const {
  absl::MutexLock lock(&mutex_);
  return written_;
}

void SessionJournal::WhenDurable(uint64_t position, Done done) {
  absl::Status outcome;
  {
    absl::MutexLock lock(&mutex_);
    outcome = missing_ ? MissingError() : loss_;
    if (outcome.ok() && stored_ < position) {
      // If the store becomes unreachable after this check, OnUnreachable() finds the waiter.
      outcome = writer_.CheckReachable();
      if (outcome.ok()) {
        waiters_.push_back({position, std::move(done)});
        return writer_.Hurry();
      }
    }
  }
  done(outcome);
}

void SessionJournal::OnWritten(const JournalRecord& record, const absl::Status& status) {
  std::vector<Waiter> ready;
  absl::Status outcome;
  {
    absl::MutexLock lock(&mutex_);
    if (absl::IsNotFound(status)) {
      // A snapshot will follow, which contains this record and the ones before.
      stored_ = 0;
      missing_ = true;
      outcome = MissingError();
      if (record.contribution != nullptr) kept_ = record.contribution;
    } else {
      stored_ = record.position;
      const bool is_taken = absl::IsAlreadyExists(status) && is_new() && record.position == 1;
      if (!status.ok() && loss_.ok()) loss_ = is_taken ? status : ReplacedError();
      outcome = loss_;
      if (!loss_.ok()) lost_ = true;
    }
    if (outcome.ok()) durable_decisions_.store(record.decisions, std::memory_order_release);
    ready = TakeReady(/*all=*/!outcome.ok());
  }
  if (outcome.ok() && record.contribution != nullptr) record.contribution->Append();
  for (const Waiter& waiter : ready) waiter.done(outcome);
}

std::vector<SessionJournal::Waiter> SessionJournal::TakeReady(bool all) {
  std::vector<Waiter> ready;
  std::vector<Waiter> others;
  for (Waiter& waiter : waiters_) {
    (all || waiter.position <= stored_ ? ready : others).push_back(std::move(waiter));
  }
  waiters_.swap(others);
  return ready;
}

void SessionJournal::OnUnreachable(const absl::Status& status) {
  std::vector<Waiter> waiters;
  {
    absl::MutexLock lock(&mutex_);
    waiters.swap(waiters_);
  }
  for (const Waiter& waiter : waiters) waiter.done(status);
}

}  // namespace spikeserve
