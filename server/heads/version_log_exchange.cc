// The methods of VersionLog that exchange entries with Redis.
#include <algorithm>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"
#include "server/heads/version_log.h"

namespace spikeserve {
namespace {

// Tries to append, each with what the log has then.
constexpr int kMostExchanges = 4;

// A snapshot is stored after this many entries.
constexpr int64_t kEntriesPerSnapshot = 1000;

// Contributors are kept alive at this interval, which is a fraction of the time that they count.
constexpr absl::Duration kMembersInterval = absl::Seconds(1);

// How long a server waits for a snapshot of another one before it cuts a log at its gap.
constexpr absl::Duration kGapPatience = absl::Seconds(5);

}  // namespace

absl::Status VersionLog::Exchange(RedisClient& client) {
  Take();
  // Redis may have lost what was in the log at an earlier attempt.
  for (Request& request : taken_) request.is_in_log = false;
  if (!has_joined_) {
    RETURN_IF_ERROR(Reload(client, ""));
    has_joined_ = true;
  }
  for (int i = 0; i < kMostExchanges; ++i) {
    ASSIGN_OR_RETURN(const auto all, AppendAndRead(client));
    if (!all) continue;
    RETURN_IF_ERROR(StoreSnapshotIfDue(client));
    return KeepMembers(client);
  }
  return absl::UnavailableError("session store: the log of a shared head changes; try again");
}

void VersionLog::NoteInLog(Request& request, bool is_new) {
  request.is_in_log = true;
  request.is_new = is_new;
  (is_new ? settings_.appended : settings_.known).Increment();
}

absl::StatusOr<bool> VersionLog::AppendAndRead(RedisClient& client) {
  for (Request& request : taken_) {
    if (!request.IsToBeAppended()) continue;
    const Contribution& entry = request.entry.contribution;
    // The log may have forgotten that it has the entry, if Redis has lost something.
    if (fold_.Find(entry.session, entry.episode).has_value()) {
      NoteInLog(request, request.is_sent);
      continue;
    }
    const auto head = heads()->Find(entry.head);
    redis_.SendAppend(client, fold_.position(), request.entry, request.bytes,
                      head == nullptr ? std::vector<std::string>() : head->Members());
  }
  redis_.SendTail(client, fold_.position());
  bool is_stale = false;
  for (Request& request : taken_) {
    if (!request.IsToBeAppended()) continue;
    const bool was_sent = std::exchange(request.is_sent, true);
    ASSIGN_OR_RETURN(const auto outcome, RedisHeadLog::ReadAppend(client));
    is_stale = is_stale || outcome == AppendOutcome::kStale;
    if (outcome == AppendOutcome::kStale || outcome == AppendOutcome::kSettling) continue;
    NoteInLog(request, outcome == AppendOutcome::kAppended || was_sent);
  }
  ASSIGN_OR_RETURN(auto tail, RedisHeadLog::ReadTail(client));
  if (settings_.replicas > 0) RETURN_IF_ERROR(client.WaitForReplicas());
  absl::Status status = FoldTail(tail);
  while (status.ok() && tail.entries.size() == RedisHeadLog::kMostEntries) {
    redis_.SendTail(client, fold_.position());
    ASSIGN_OR_RETURN(tail, RedisHeadLog::ReadTail(client));
    status = FoldTail(tail);
  }
  if (absl::IsDataLoss(status)) status = Reload(client, status.message());
  if (!status.ok()) return status;
  position_.store(fold_.position().number, std::memory_order_relaxed);
  return !is_stale;
}

absl::Status VersionLog::FoldTail(const StoredLog& tail) {
  snapshot_number_ = tail.snapshot.number;
  wants_snapshot_ = tail.wants_snapshot;
  size_t first = 0;
  if (fold_.position().number > 0) {
    if (tail.entries.empty() || tail.entries[0].position != fold_.position()) {
      return absl::DataLossError(
          absl::StrCat("the log does not have entry ", fold_.position().number, " any more"));
    }
    first = 1;
  } else if (tail.snapshot.number > 0) {
    return absl::DataLossError("the log has a snapshot, but no entry was taken");
  }
  for (size_t i = first; i < tail.entries.size(); ++i) {
    RETURN_IF_ERROR(fold_.Fold(tail.entries[i]));
    settings_.folded.Increment();
  }
  return absl::OkStatus();
}

absl::Status VersionLog::Reload(RedisClient& client, absl::string_view reason) {
  ASSIGN_OR_RETURN(const auto stored, redis_.Load(client));
  HeadFold whole(std::make_shared<TenantHeads>(heads()->policy()));
  if (!stored.bytes.empty()) {
    if (auto status = whole.Restore(stored.snapshot, stored.bytes); !status.ok()) {
      // Damaged, or of a later release. A server that has the heads stores them again.
      redis_.AskForSnapshot(client).IgnoreError();
      return status;
    }
  }
  const HeadPosition end =
      stored.entries.empty() ? whole.position() : stored.entries.back().position;
  for (const LoggedEntry& entry : stored.entries) {
    if (entry.position == whole.position()) continue;
    const absl::Status status = whole.Fold(entry);
    if (absl::IsDataLoss(status)) return MendGap(client, whole, end);
    if (!status.ok()) return status;
  }
  gap_since_.reset();
  const bool store_is_behind =
      fold_.position().number > whole.position().number && fold_.HasPassed(whole.position());
  if (store_is_behind) return Rewrite(client, fold_, end, reason);
  fold_.TakeOver(whole);
  snapshot_number_ = stored.snapshot.number;
  // Entries are appended behind others: a log that is gone begins again behind its snapshot.
  if (stored.entries.empty() && end.number > 0) {
    return Rewrite(client, fold_, end, "the log is gone, and its snapshot is not");
  }
  if (reason.empty()) return absl::OkStatus();
  settings_.reloaded.Increment();
  LogWarning("shared heads reloaded from their log", {{"policy", name_}, {"reason", reason}});
  return absl::OkStatus();
}

absl::Status VersionLog::Rewrite(RedisClient& client, const HeadFold& heads,
                                 const HeadPosition& end, absl::string_view reason) {
  RETURN_IF_ERROR(redis_.Replace(client, end.digest, heads));
  settings_.rewritten.Increment();
  LogWarning("shared heads written to their log again", {{"policy", name_}, {"reason", reason}});
  return absl::OkStatus();
}

absl::Status VersionLog::MendGap(RedisClient& client, const HeadFold& whole,
                                 const HeadPosition& end) {
  const std::string number = absl::StrCat(whole.position().number);
  if (!gap_since_.has_value()) {
    gap_since_ = settings_.clock->Now();
    LogError("the log of shared heads lacks entries; asks the other servers for their heads",
             {{"policy", name_}, {"last_entry", number}});
  }
  if (settings_.clock->Now() - *gap_since_ < kGapPatience) {
    RETURN_IF_ERROR(redis_.AskForSnapshot(client));
    return absl::UnavailableError("session store: the log of a shared head lacks entries");
  }
  RETURN_IF_ERROR(Rewrite(client, whole, end, "no server has the entries after the gap"));
  settings_.cut.Increment();
  LogError("the log of shared heads was cut; what came after the gap is lost",
           {{"policy", name_}, {"last_entry", number}});
  fold_.TakeOver(whole);
  gap_since_.reset();
  return absl::OkStatus();
}

absl::Status VersionLog::StoreSnapshotIfDue(RedisClient& client) {
  const int64_t number = fold_.position().number;
  // A server that appends stores the snapshot; any other one does if that one was lost.
  const bool has_appended =
      std::any_of(taken_.begin(), taken_.end(), [](const Request& each) { return each.is_new; });
  const int64_t most = has_appended ? kEntriesPerSnapshot : 2 * kEntriesPerSnapshot;
  if (number == 0 || (number - snapshot_number_ < most && !wants_snapshot_)) {
    return absl::OkStatus();
  }
  wants_snapshot_ = false;
  return redis_.StoreSnapshot(client, fold_);
}

absl::Status VersionLog::KeepMembers(RedisClient& client) {
  const absl::Duration now = settings_.clock->Now();
  if (now - members_kept_ < kMembersInterval) return absl::OkStatus();
  members_kept_ = now;
  return redis_.KeepMembers(client, *heads());
}

MergeOutcome VersionLog::OutcomeOf(const Request& request) const {
  const Contribution& entry = request.entry.contribution;
  if (auto outcome = fold_.Find(entry.session, entry.episode); outcome.has_value()) return *outcome;
  // An entry from before those that are remembered, or none.
  MergeOutcome outcome;
  if (const auto head = heads()->Find(entry.head); head != nullptr) {
    outcome.drift = head->Read()->drift;
    outcome.watched_return = head->Read()->level.mean;
  }
  return outcome;
}

}  // namespace spikeserve
