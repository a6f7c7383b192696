#include "server/agent/session_recovery.h"

#include <memory>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/agent/head_log.h"
#include "core/base/status_macros.h"
#include "core/journal/journal_entry.h"
#include "core/journal/session_journal.h"
#include "core/session/session_id.h"
#include "core/store/sealed_record.h"
#include "server/base/log.h"
#include "server/policies/policy_catalog.h"
#include "server/store/lost_session.h"

namespace spikeserve {
namespace {

// Finds the version that the session was opened on. UNAVAILABLE unless this server has it.
absl::StatusOr<std::shared_ptr<const ServedPolicy>> FindPolicy(const SessionOptions& options,
                                                               const PolicyRegistry& registry) {
  auto served = registry.catalog()->Find(options.policy, options.version);
  if (served.ok() && (*served)->sha256 == options.policy_sha256) return served;
  return absl::UnavailableError(absl::StrCat(
      "session_id: expected a session whose policy this server has, received one of ",
      options.policy, " version ", options.version,
      served.ok() ? ", whose file is another one here" : ", which is not served here"));
}

// Returns whether the version with this file is served here.
bool HasPolicy(const PolicyCatalog& catalog, absl::string_view file) {
  const size_t at = file.rfind('@');
  const size_t colon = file.find(':', at == absl::string_view::npos ? 0 : at);
  int64_t version = 0;
  if (at == absl::string_view::npos || colon == absl::string_view::npos ||
      !absl::SimpleAtoi(file.substr(at + 1, colon - at - 1), &version)) {
    return false;
  }
  const auto served = catalog.Find(std::string(file.substr(0, at)), version);
  return served.ok() && PolicyFileOf(**served) == file;
}

// Returns the contribution that the session has not been told the outcome of, or null.
std::shared_ptr<FleetContribution> ContributionOf(SessionStore& sessions, const std::string& id,
                                                  const std::string& tenant) {
  const auto entry = sessions.Peek(id, tenant);
  if (entry == nullptr) return nullptr;
  absl::MutexLock lock(&entry->mutex);
  return entry->agent.contribution();
}

// Returns whether the copy was given up by this server itself, and no other owner is known.
bool IsGivenUp(const SessionEntry& entry) {
  if (entry.journal == nullptr || !entry.journal->is_shared() || !entry.journal->lost()) {
    return false;
  }
  absl::Status refusal;  // told at once, because nothing is to be written
  entry.journal->WhenDurable(0, [&](const absl::Status& status) { refusal = status; });
  return refusal.ok();
}

// Replaces `session`, which was claimed, by the copy that this server had given up, if the store
// had acknowledged more of that. Returns whether it did.
bool GoOnFrom(SessionEntry& former, Session* session) {
  if (!IsGivenUp(former) || former.journal->durable_changes() <= session->changes()) return false;
  absl::MutexLock lock(&former.mutex);
  *session = former.agent.session();
  return true;
}

}  // namespace

bool IsDrawnSessionId(absl::string_view id) {
  return id.size() == 32 && id.find_first_not_of("0123456789abcdef") == absl::string_view::npos;
}

std::string PolicyFileOf(const ServedPolicy& served) {
  return absl::StrCat(served.name, "@", served.version, ":", served.sha256);
}

void SessionRecovery::Recover(const Credential& caller, const std::string& id, const Post& post,
                              Done done) {
  if (!IsDrawnSessionId(id)) return done(NoSuchSession(id));
  const Key key = {caller.tenant()->name(), id};
  bool is_first = false;
  bool is_here = false;
  {
    absl::MutexLock lock(&mutex_);
    is_first = !claims_.contains(key);
    // A claim is removed after its session was added. Therefore a session that is neither here nor
    // being claimed is in the store.
    const auto copy = is_first ? sessions_.Peek(id, key.first) : nullptr;
    if (copy != nullptr && copy->tenant == key.first && IsGivenUp(*copy)) former_.Keep(key, copy);
    is_here = is_first && sessions_.Find(id, key.first).ok();
    if (!is_here) claims_[key].push_back({post, std::move(done)});
  }
  if (is_here) return done(absl::OkStatus());
  if (!is_first) return;
  const std::shared_ptr<SessionQuota> quota = caller.tenant();
  journals_.Claim(ClaimOf(key), [=, this](absl::StatusOr<ClaimedJournal> result) {
    const auto claimed = std::make_shared<absl::StatusOr<ClaimedJournal>>(std::move(result));
    post([=, this] {
      const absl::Status status = Restore(key, quota, std::move(*claimed));
      const auto contribution = status.ok() ? ContributionOf(sessions_, id, key.first) : nullptr;
      if (contribution == nullptr) return Finish(key, status);
      // The next episode could not end before. If the log of the head cannot be reached, the
      // session continues without.
      contribution->WhenMerged([=, this](const absl::Status&) { Finish(key, absl::OkStatus()); });
    });
  });
}

JournalClaim SessionRecovery::ClaimOf(const Key& key) const {
  return {.id = key.second, .tenant = key.first, .has_policy = [this](const std::string& file) {
            return HasPolicy(*registry_.catalog(), file);
          }};
}

void SessionRecovery::Read(const Credential& caller, const std::string& id, const Post& post,
                           WhenRead done) {
  if (!IsDrawnSessionId(id)) return done(NoSuchSession(id));
  const Key key = {caller.tenant()->name(), id};
  JournalClaim claim = ClaimOf(key);
  claim.only_reads = true;
  // `done` may hold a call, which must be destroyed on the thread of its loop.
  journals_.Claim(std::move(claim), [this, key, post, done = std::move(done)](
                                        absl::StatusOr<ClaimedJournal> result) mutable {
    post([this, key, done = std::move(done), result = std::move(result)]() mutable {
      if (!result.ok()) return done(result.status());
      auto restored = Unfold(key, &*result);
      if (!restored.ok()) return done(restored.status());
      done(std::make_shared<SessionEntry>(std::move(restored->served), std::move(restored->session),
                                          &clock_));
    });
  });
}

absl::StatusOr<SessionRecovery::Restored> SessionRecovery::Unfold(const Key& key,
                                                                  ClaimedJournal* claimed) const {
  Restored restored;
  restored.cut = CutDamagedEnd(&claimed->records);
  ASSIGN_OR_RETURN(auto journal, ParseJournal(claimed->records));
  const SessionOptions options = journal.snapshot.options;
  if (journal.snapshot.id != key.second || options.tenant != key.first ||
      options.durability == Durability::kNone) {
    return absl::DataLossError("journal: expected the session's own, received another one");
  }
  ASSIGN_OR_RETURN(auto served, FindPolicy(options, registry_));
  restored.entries = journal.entries.size();
  restored.after_gap = journal.after_gap;
  ASSIGN_OR_RETURN(auto session, RestoreSession(std::move(journal), served->policy()));
  restored.served = std::move(served);
  restored.session = std::move(session);
  return restored;
}

absl::Status SessionRecovery::Restore(const Key& key, std::shared_ptr<SessionQuota> quota,
                                      absl::StatusOr<ClaimedJournal> claimed) {
  if (IsLost(claimed.status())) return TakeBack(key, std::move(quota));
  if (absl::IsUnavailable(claimed.status())) former_.WaitAgain(key);
  const bool is_known = claimed.ok() || absl::IsNotFound(claimed.status());
  const auto former = is_known ? former_.Take(key) : nullptr;
  if (!claimed.ok()) return claimed.status();
  ASSIGN_OR_RETURN(auto restored, Unfold(key, &*claimed));
  if (claimed->epoch == 0) {
    return absl::UnavailableError(
        "session_id: expected a session whose policy this server had when it asked the store; try "
        "again");
  }
  journals_.CountReplayed(restored.entries);
  const bool is_set_back = former != nullptr && GoOnFrom(*former, &restored.session);
  const auto& served = restored.served;
  const Durability durability = restored.session.options.durability;
  SessionExtras extras;
  extras.quota = std::move(quota);
  extras.journal = std::make_shared<SessionJournal>(
      SessionJournal::Key{.id = key.second,
                          .tenant = key.first,
                          .epoch = claimed->epoch,
                          .policy_file = PolicyFileOf(*served),
                          .claimed_from = claimed->claimed_from,
                          .ended = restored.session.episode,
                          .interventions = restored.session.interventions,
                          .stored_as = claimed->stored_as},
      durability, restored.session.decisions, &journals_, claimed->records.size(),
      /*is_whole=*/restored.after_gap == 0 && !is_set_back);
  RETURN_IF_ERROR(Add(served, std::move(restored.session), std::move(extras)));
  if (restored.after_gap > 0) {
    LogWarning("journal goes on before its gap", {{"session", key.second}});
  }
  if (restored.cut.ok()) return absl::OkStatus();
  LogError("end of a journal cut off",
           {{"session", key.second}, {"error", restored.cut.message()}});
  return absl::OkStatus();
}

absl::Status SessionRecovery::TakeBack(const Key& key, std::shared_ptr<SessionQuota> quota) {
  ASSIGN_OR_RETURN(const auto former, former_.TakeBack(key));
  SessionEntry& entry = *former;
  // The store may have told meanwhile that another server had taken the session over.
  if (!IsGivenUp(entry)) return NoSuchSession(key.second);
  Session session;
  {
    absl::MutexLock lock(&entry.mutex);
    session = entry.agent.session();
  }
  SessionExtras extras;
  extras.quota = std::move(quota);
  // At its epoch, so that a server that has claimed the session from this one, and comes late,
  // knows its own copy for the newer one.
  SessionJournal::Key journal = entry.journal->key();
  journal.epoch = entry.journal->epoch();
  journal.stored_as = entry.journal->stored_as();
  journal.ended = session.episode;
  journal.interventions = session.interventions;
  extras.journal =
      std::make_shared<SessionJournal>(std::move(journal), session.options.durability,
                                       session.decisions, &journals_, 0, /*is_whole=*/false);
  LogWarning("session goes on from a former copy, because the store has lost it",
             {{"session", key.second}});
  return Add(entry.served, std::move(session), std::move(extras));
}

absl::Status SessionRecovery::Add(std::shared_ptr<const ServedPolicy> served, Session session,
                                  SessionExtras extras) {
  if (recordings_ != nullptr && !session.options.recording.empty()) {
    extras.recorder =
        recordings_->Record(served, session.options.recording, session.options.tenant);
  }
  return sessions_.Restore(std::move(served), std::move(session), std::move(extras));
}

void SessionRecovery::Finish(const Key& key, const absl::Status& status) {
  if (absl::IsDataLoss(status)) {
    LogError("session not restored", {{"session", key.second}, {"error", status.message()}});
  }
  std::vector<Waiter> waiters;
  {
    absl::MutexLock lock(&mutex_);
    const auto claim = claims_.find(key);
    if (claim == claims_.end()) return;  // forgotten
    waiters = std::move(claim->second);
    claims_.erase(claim);
  }
  for (Waiter& waiter : waiters) {
    // Moved, because `done` may hold a call, which must be destroyed on the thread of its loop.
    waiter.post([done = std::move(waiter.done), status] { done(status); });
  }
}

void SessionRecovery::ForgetWaiters() {
  std::map<Key, std::vector<Waiter>> claims;  // destroyed outside the lock
  absl::MutexLock lock(&mutex_);
  claims.swap(claims_);
}

}  // namespace spikeserve
