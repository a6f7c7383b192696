#include "core/journal/session_journal.h"

#include <algorithm>
#include <limits>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/journal/session_bytes.h"

namespace spikeserve {
namespace {

constexpr uint64_t kNoPosition = std::numeric_limits<uint64_t>::max();

absl::Status ReplacedError() {
  return absl::UnavailableError(
      "session_id: expected a session of this server, received one that another server has taken "
      "over; try again");
}

}  // namespace

SessionJournal::SessionJournal(Key key, Durability durability, uint64_t decisions,
                               JournalWriter* writer, size_t records, bool is_whole)
    : key_(std::move(key)),
      is_sync_(durability == Durability::kSync),
      is_new_(key_.epoch == 1 && is_whole),
      writer_(*writer),
      durable_decisions_(decisions),
      durable_episodes_(key_.ended),
      missing_(!is_whole),
      first_valid_(is_whole ? 0 : kNoPosition),
      decisions_(decisions),
      durable_changes_(decisions + static_cast<uint64_t>(key_.ended) + key_.interventions),
      stored_as_(key_.stored_as.empty() ? &key_.id : &key_.stored_as),
      epoch_(key_.epoch),
      replaces_(key_.claimed_from),
      episodes_(key_.ended),
      changes_(durable_changes_),
      records_(records),
      acknowledged_({.base = 0, .records = records}) {
  SPIKESERVE_DCHECK(durability != Durability::kNone);
}

absl::Status SessionJournal::CheckWritable() const {
  if (is_sync_) {
    RETURN_IF_ERROR(writer_.CheckReachable());
    if (auto status = writer_.CheckKeepsRecords(); !status.ok()) {
      return absl::UnavailableError(status.message());
    }
  } else if (decisions_.load(std::memory_order_relaxed) - durable_decisions() >= kMostUnwritten) {
    return absl::UnavailableError(
        absl::StrCat("session store: expected fewer than ", kMostUnwritten,
                     " decisions of the session that are not stored yet; try again"));
  }
  return writer_.CheckBacklog();
}

void SessionJournal::OnOpen(const Session& session) {
  Write(JournalRecord::Kind::kOpen, SerializeSession(session), &session);
}

void SessionJournal::OnDecision(const Session& session, const DecisionInputs& inputs) {
  // A snapshot with factors of many steps is written after as many entries as it has steps.
  const size_t kept = session.learner.has_value() ? session.learner->kept_steps() : 0;
  if (inputs.needs_snapshot || records_ >= std::max(kDecisionsPerSnapshot, kept)) {
    return OnChange(session);
  }
  JournalEntryView entry = {.decision = session.decisions - 1,
                            .reward = inputs.reward,
                            .observation = session.history.observation(session.history.size() - 1),
                            .executed = inputs.executed,
                            .answer = *session.last_answer,
                            .readout = {},
                            .noise = {}};
  if (session.learner.has_value()) {
    entry.readout = inputs.readout;
    entry.noise = inputs.noise;
    entry.suspended = session.learner->suspended;
  }
  Write(JournalRecord::Kind::kEntry, SerializeEntry(entry), &session);
}

void SessionJournal::OnChange(const Session& session) {
  Write(JournalRecord::Kind::kSnapshot, SerializeSession(session), &session);
}

bool SessionJournal::OnEpisodeEnd(const Session& session,
                                  const std::shared_ptr<FleetContribution>& contribution) {
  Write(JournalRecord::Kind::kSnapshot, SerializeSession(session), &session, contribution);
  return true;
}

void SessionJournal::OnRelease(const Session& session) {
  if (lost()) return;
  Write(JournalRecord::Kind::kRelease, SerializeSession(session), &session);
}

void SessionJournal::OnClose() {
  if (!lost()) Write(JournalRecord::Kind::kClose, "", nullptr);
}

bool SessionJournal::Withdraw() {
  std::vector<Waiter> waiters;
  const absl::Status loss = absl::UnavailableError(
      "session_id: expected an open session, received one whose opening the store refused; try "
      "again");
  {
    absl::MutexLock lock(&mutex_);
    if (!loss_.ok()) return true;
    if (stored_ > 0) return false;
    withdrawn_ = true;
    first_valid_.store(kNoPosition, std::memory_order_release);  // the writer leaves out what waits
    loss_ = loss;
    lost_ = true;
    waiters = TakeReady(/*all=*/true);
  }
  for (const Waiter& waiter : waiters) waiter.done(loss);
  return true;
}

void SessionJournal::OnConfirm() { Write(JournalRecord::Kind::kConfirm, "", nullptr); }

void SessionJournal::WriteAgainIfMissing(const Session& session) {
  if (!missing_.exchange(false, std::memory_order_acq_rel) || lost()) return;
  OnOpen(session);
}

void SessionJournal::Write(JournalRecord::Kind kind, std::string bytes, const Session* session,
                           const std::shared_ptr<FleetContribution>& contribution) {
  if (session != nullptr) {
    decisions_.store(session->decisions, std::memory_order_relaxed);
    episodes_ = session->episode;
    changes_ = session->changes();
  }
  const bool is_snapshot =
      kind != JournalRecord::Kind::kEntry && kind != JournalRecord::Kind::kConfirm;
  if (is_snapshot) records_ = 0;  // replaces what was there
  if (kind != JournalRecord::Kind::kConfirm) ++records_;
  JournalRecord record = {.kind = kind,
                          .bytes = std::move(bytes),
                          .decisions = decisions_.load(std::memory_order_relaxed),
                          .episodes = episodes_,
                          .changes = changes_,
                          .records = records_,
                          .journal = shared_from_this()};
  // The lock makes the order of the queue that of the positions.
  absl::MutexLock lock(&mutex_);
  if (withdrawn_) return;
  record.position = ++written_;
  if (contribution != nullptr) {
    contribution_ = contribution;
    contribution_position_ = written_;
  }
  if (is_snapshot) base_ = record.position;
  record.base = base_;
  if (is_snapshot && first_valid_.load(std::memory_order_relaxed) == kNoPosition) {
    first_valid_.store(record.position, std::memory_order_release);
  }
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
    outcome = loss_;
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

SessionJournal::Stored SessionJournal::stored() const {
  absl::MutexLock lock(&mutex_);
  return acknowledged_;
}

void SessionJournal::LoseRecords() {
  stored_ = 0;
  acknowledged_ = {};
  first_valid_.store(kNoPosition, std::memory_order_release);
  missing_.store(true, std::memory_order_release);
}

void SessionJournal::OnWritten(const JournalRecord& record, const absl::Status& status) {
  std::vector<Waiter> ready;
  std::shared_ptr<FleetContribution> contribution;
  absl::Status outcome;
  {
    absl::MutexLock lock(&mutex_);
    if (absl::IsNotFound(status) && record.kind != JournalRecord::Kind::kClose) {
      // A snapshot will follow, which has this record and the ones before. Answers wait for it.
      return LoseRecords();
    }
    stored_ = record.position;
    acknowledged_ = {.base = record.base, .records = record.records};
    const bool is_taken = absl::IsAlreadyExists(status) && is_new() && record.position == 1;
    const bool is_refused = !status.ok() && !absl::IsNotFound(status);
    if (is_refused && loss_.ok()) loss_ = is_taken ? status : ReplacedError();
    outcome = loss_;
    if (!loss_.ok()) lost_ = true;
    if (outcome.ok()) {
      durable_decisions_.store(record.decisions, std::memory_order_release);
      durable_episodes_.store(record.episodes, std::memory_order_release);
      durable_changes_.store(record.changes, std::memory_order_release);
      is_set_back_.store(false, std::memory_order_release);
      if (stored_ >= contribution_position_) contribution = std::exchange(contribution_, nullptr);
    }
    ready = TakeReady(/*all=*/!outcome.ok());
  }
  if (contribution != nullptr) contribution->Append();
  for (const Waiter& waiter : ready) waiter.done(outcome);
}

void SessionJournal::OnChecked(const absl::Status& status) {
  std::vector<Waiter> ready;
  {
    absl::MutexLock lock(&mutex_);
    if (absl::IsNotFound(status)) LoseRecords();
    if (!absl::IsAborted(status)) return;
    if (loss_.ok()) loss_ = ReplacedError();
    lost_ = true;
    ready = TakeReady(/*all=*/true);
  }
  for (const Waiter& waiter : ready) waiter.done(ReplacedError());
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
