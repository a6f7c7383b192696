#include "server/heads/logged_heads.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

// Contributors are kept alive at this interval, which is a fraction of the time that they count.
constexpr absl::Duration kMembersInterval = absl::Seconds(1);

// How long a server waits for a snapshot of another one before it cuts a log at its gap.
constexpr absl::Duration kGapPatience = absl::Seconds(5);

}  // namespace

LoggedHeads::LoggedHeads(const HeadLogSettings* settings, const ServedPolicy& served)
    : settings_(*settings),
      name_(absl::StrCat(served.name, "/", served.version)),
      labels_({{"policy", served.name}, {"version", absl::StrCat(served.version)}}),
      keys_(served.name, served.version, served.sha256),
      replica_(std::make_shared<TenantHeads>(
          std::shared_ptr<const Policy>(served.engine, &served.policy()))) {}

absl::Status LoggedHeads::Exchange(RedisClient& client, absl::Span<HeadRequest> requests) {
  // Redis may have lost what was in the log at an earlier attempt.
  for (HeadRequest& request : requests) request.is_in_log = false;
  if (!has_joined_) {
    RETURN_IF_ERROR(Reload(client, ""));
    has_joined_ = true;
  }
  constexpr int kMostAttempts = 4;
  for (int i = 0; i < kMostAttempts; ++i) {
    ASSIGN_OR_RETURN(const auto all, AppendAndRead(client, requests));
    if (!all) continue;
    const bool has_appended =
        std::any_of(requests.begin(), requests.end(), [](const auto& each) { return each.is_new; });
    RETURN_IF_ERROR(StoreSnapshotIfDue(client, has_appended));
    return KeepMembers(client);
  }
  return absl::UnavailableError("session store: the log of a shared head changes; try again");
}

absl::StatusOr<bool> LoggedHeads::AppendAndRead(RedisClient& client,
                                                absl::Span<HeadRequest> requests) {
  HeadLogMetrics& metrics = *settings_.metrics;
  for (HeadRequest& request : requests) {
    if (!request.IsToBeAppended()) continue;
    // The log may have forgotten that it has the entry, if Redis has lost something.
    if (replica_.Find(request.append.session, request.append.episode).has_value()) {
      request.is_in_log = true;
      request.is_new = request.is_sent;
      (request.is_new ? metrics.appended : metrics.known).Increment();
      continue;
    }
    if (const auto head = heads()->Find(request.append.head); head != nullptr) {
      request.append.members = head->Members();
    }
    SendHeadAppend(client, keys_, replica_.position(), request.append, settings_.retention);
  }
  SendHeadTail(client, keys_, replica_.position());
  bool is_stale = false;
  for (HeadRequest& request : requests) {
    if (!request.IsToBeAppended()) continue;
    const bool was_sent = std::exchange(request.is_sent, true);
    ASSIGN_OR_RETURN(const auto outcome, ReadHeadAppend(client));
    is_stale = is_stale || outcome == AppendOutcome::kStale;
    if (outcome == AppendOutcome::kStale || outcome == AppendOutcome::kSettling) continue;
    request.is_in_log = true;
    request.is_new = outcome == AppendOutcome::kAppended || was_sent;
    (request.is_new ? metrics.appended : metrics.known).Increment();
  }
  ASSIGN_OR_RETURN(const auto tail, ReadHeadTail(client));
  if (settings_.replicas > 0) {
    RETURN_IF_ERROR(client.WaitForReplicas());
  }
  auto status = FoldTail(tail);
  if (status.ok() && tail.entries.size() == kMostTailEntries) status = ReadOn(client);
  if (absl::IsDataLoss(status)) status = Reload(client, status.message());
  if (!status.ok()) return status;
  metrics.positions.Add(labels_).Set(static_cast<double>(replica_.position().number));
  return !is_stale;
}

absl::Status LoggedHeads::ReadOn(RedisClient& client) {
  while (true) {
    SendHeadTail(client, keys_, replica_.position());
    ASSIGN_OR_RETURN(const auto tail, ReadHeadTail(client));
    RETURN_IF_ERROR(FoldTail(tail));
    if (tail.entries.size() < kMostTailEntries) return absl::OkStatus();
  }
}

absl::Status LoggedHeads::FoldTail(const LogTail& tail) {
  snapshot_number_ = tail.snapshot_number;
  wants_snapshot_ = tail.wants_snapshot;
  size_t first = 0;
  if (replica_.position().number > 0) {
    if (tail.entries.empty() || tail.entries[0].position != replica_.position()) {
      return absl::DataLossError(
          absl::StrCat("the log does not have entry ", replica_.position().number, " any more"));
    }
    first = 1;
  } else if (tail.snapshot_number > 0) {
    return absl::DataLossError("the log has a snapshot, but no entry was taken");
  }
  for (size_t i = first; i < tail.entries.size(); ++i) {
    ASSIGN_OR_RETURN(const auto folded, replica_.Fold(tail.entries[i]));
    outcomes_[{folded.session, folded.episode}] = folded.outcome;
    settings_.metrics->folded.Increment();
  }
  return absl::OkStatus();
}

absl::Status LoggedHeads::Reload(RedisClient& client, absl::string_view reason) {
  ASSIGN_OR_RETURN(const auto stored, LoadHeadLog(client, keys_));
  HeadReplica whole(std::make_shared<TenantHeads>(heads()->policy()));
  if (!stored.bytes.empty()) {
    if (auto status = whole.Restore(stored.snapshot, stored.bytes); !status.ok()) {
      // Damaged, or of a later release. A server that has the heads stores them again.
      AskForHeadSnapshot(client, keys_).IgnoreError();
      return status;
    }
  }
  const HeadPosition end =
      stored.entries.empty() ? whole.position() : stored.entries.back().position;
  for (const LoggedEntry& entry : stored.entries) {
    if (entry.position == whole.position()) continue;
    const auto folded = whole.Fold(entry);
    if (absl::IsDataLoss(folded.status())) return MendGap(client, whole, end);
    if (!folded.ok()) return folded.status();
    outcomes_[{folded->session, folded->episode}] = folded->outcome;
  }
  gap_since_.reset();
  const bool store_is_behind =
      replica_.position().number > whole.position().number && replica_.HasPassed(whole.position());
  if (store_is_behind) return Rewrite(client, replica_, end, reason);
  replica_.TakeOver(whole);
  snapshot_number_ = stored.snapshot.number;
  // Entries are appended behind others: a log that is gone begins again behind its snapshot.
  if (stored.entries.empty() && end.number > 0) {
    return Rewrite(client, replica_, end, "the log is gone, and its snapshot is not");
  }
  if (reason.empty()) return absl::OkStatus();
  settings_.metrics->reloaded.Increment();
  LogWarning("shared heads reloaded from their log", {{"policy", name_}, {"reason", reason}});
  return absl::OkStatus();
}

absl::Status LoggedHeads::Rewrite(RedisClient& client, const HeadReplica& replica,
                                  const HeadPosition& end, absl::string_view reason) {
  const auto status =
      ReplaceHeadLog(client, keys_, end.digest, replica.position(), replica.Serialize());
  if (absl::IsAborted(status)) return absl::UnavailableError(status.message());
  if (!status.ok()) return status;
  // Those of older entries stay, unless Redis has lost them, too.
  std::vector<HeadMarker> markers;
  for (const HeadReplica::Folded& folded : replica.last()) {
    markers.push_back({folded.session, folded.episode, folded.position.id});
  }
  if (auto restored = RestoreHeadMarkers(client, keys_, markers, settings_.retention);
      !restored.ok()) {
    return restored;
  }
  settings_.metrics->rewritten.Increment();
  LogWarning("shared heads written to their log again", {{"policy", name_}, {"reason", reason}});
  return absl::OkStatus();
}

absl::Status LoggedHeads::MendGap(RedisClient& client, const HeadReplica& whole,
                                  const HeadPosition& end) {
  const std::string number = absl::StrCat(whole.position().number);
  if (!gap_since_.has_value()) {
    gap_since_ = settings_.clock->Now();
    LogError("the log of shared heads lacks entries; asks the other servers for their heads",
             {{"policy", name_}, {"last_entry", number}});
  }
  if (settings_.clock->Now() - *gap_since_ < kGapPatience) {
    RETURN_IF_ERROR(AskForHeadSnapshot(client, keys_));
    return absl::UnavailableError("session store: the log of a shared head lacks entries");
  }
  if (auto status = Rewrite(client, whole, end, "no server has the entries after the gap");
      !status.ok()) {
    return status;
  }
  settings_.metrics->cut.Increment();
  LogError("the log of shared heads was cut; what came after the gap is lost",
           {{"policy", name_}, {"last_entry", number}});
  replica_.TakeOver(whole);
  gap_since_.reset();
  return absl::OkStatus();
}

absl::Status LoggedHeads::StoreSnapshotIfDue(RedisClient& client, bool has_appended) {
  const HeadPosition& position = replica_.position();
  // A server that appends stores the snapshot; any other one does if that one was lost.
  const int64_t entries = position.number - snapshot_number_;
  const int64_t most = has_appended ? kEntriesPerSnapshot : 2 * kEntriesPerSnapshot;
  if (position.number == 0 || (entries < most && !wants_snapshot_)) return absl::OkStatus();
  wants_snapshot_ = false;
  return StoreHeadSnapshot(client, keys_, position, replica_.Serialize());
}

absl::Status LoggedHeads::KeepMembers(RedisClient& client) {
  const absl::Duration now = settings_.clock->Now();
  if (now - members_kept_ < kMembersInterval) return absl::OkStatus();
  members_kept_ = now;
  size_t sent = 0;
  for (const std::string& tenant : heads()->Tenants()) {
    const auto members = heads()->Of(tenant)->Members();
    if (members.empty()) continue;
    SendHeadMembers(client, keys_, tenant, members);
    ++sent;
  }
  for (; sent > 0; --sent) {
    if (const auto reply = client.Read(); !reply.ok()) return reply.status();
  }
  return absl::OkStatus();
}

MergeOutcome LoggedHeads::OutcomeOf(const HeadRequest& request) const {
  const HeadAppend& append = request.append;
  const auto folded = outcomes_.find({append.session, append.episode});
  if (folded != outcomes_.end()) return folded->second;
  if (!append.bytes.empty()) {
    const auto outcome = replica_.Find(append.session, append.episode);
    if (outcome.has_value()) return *outcome;
  }
  // An entry from before those that are remembered.
  MergeOutcome outcome;
  if (const auto head = heads()->Find(append.head); head != nullptr) {
    outcome.drift = head->Read()->drift;
    outcome.watched_return = head->Read()->level.mean;
  }
  return outcome;
}

}  // namespace spikeserve
