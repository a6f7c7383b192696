#include "server/heads/version_log.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/session/session_id.h"
#include "server/base/log.h"
#include "server/base/retry_delay.h"

namespace spikeserve {
namespace {

// How long a call of an operator waits for the log.
constexpr absl::Duration kOperationTimeout = absl::Seconds(5);

constexpr absl::Duration kFirstRetry = absl::Milliseconds(100);
constexpr absl::Duration kLongestRetry = absl::Seconds(1);

// A connection that breaks fails once. What fails again has another cause, which is logged.
constexpr int kFailuresToLog = 2;

// How long the settings and a log may differ in a pause: longer than a change of the settings takes
// to reach this server.
constexpr absl::Duration kPausePatience = absl::Seconds(5);

// Returns a request for an entry without a session.
HeadRequest NewRequest(HeadEntry::Kind kind, const std::string& head = "") {
  const auto id = NewSessionId();  // any random name
  const HeadEntry entry = {.kind = kind,
                           .session = id.ok() ? *id : "",
                           .head = head,
                           .contributor = "",
                           .delta = {},
                           .episode_return = 0.0};
  return {.append = {.session = entry.session,
                     .episode = 0,
                     .head = head,
                     .bytes = id.ok() ? SerializeHeadEntry(entry) : "",
                     .identity = HeadEntryIdentity(entry),
                     .members = {}}};
}

HeadEntry::Kind PauseKind(bool paused) {
  return paused ? HeadEntry::Kind::kPause : HeadEntry::Kind::kResume;
}

}  // namespace

VersionLog::VersionLog(const HeadLogSettings* settings, const ServedPolicy& served,
                       std::function<void()> wake)
    : settings_(*settings),
      learning_(served.learning),
      requests_(std::move(wake)),
      logged_(settings, served),
      retry_delay_(kFirstRetry) {}

void VersionLog::Append(std::shared_ptr<FleetContribution> contribution) {
  const PendingContribution& pending = contribution->pending();
  const HeadEntry entry = {.kind = HeadEntry::Kind::kMerge,
                           .session = contribution->session(),
                           .episode = pending.episode,
                           .head = contribution->head(),
                           .contributor = contribution->contributor(),
                           .held_out = contribution->held_out(),
                           .delta = pending.delta,
                           .episode_return = pending.episode_return};
  requests_.Add({.append = {.session = entry.session,
                            .episode = entry.episode,
                            .head = entry.head,
                            .bytes = SerializeHeadEntry(entry),
                            .identity = HeadEntryIdentity(entry),
                            .members = {}},
                 .contribution = std::move(contribution)});
}

absl::StatusOr<MergeOutcome> VersionLog::Do(HeadRequest request) {
  const auto operation = std::make_shared<HeadOperation>();
  request.operation = operation;
  requests_.Add(std::move(request));
  if (operation->done.WaitFor(kOperationTimeout)) return operation->outcome;
  return WithRetryDelay(
      absl::UnavailableError("session store: has not answered about a shared head; try again"),
      kFirstRetry);
}

absl::Status VersionLog::CatchUp() { return Do({}).status(); }

absl::StatusOr<double> VersionLog::Rollback(const std::string& tenant) {
  RETURN_IF_ERROR(CatchUp());
  // A tenant that has learned nothing gets no head.
  if (heads()->Find(tenant) == nullptr) return 0.0;
  ASSIGN_OR_RETURN(const auto outcome, Do(NewRequest(HeadEntry::Kind::kRollback, tenant)));
  return outcome.drift;
}

absl::Status VersionLog::SetPaused(bool paused) {
  return Do(NewRequest(PauseKind(paused))).status();
}

void VersionLog::NoteUse() {
  const auto tenants = heads()->Tenants();
  const bool is_used = std::any_of(tenants.begin(), tenants.end(), [&](const auto& tenant) {
    return !heads()->Of(tenant)->Members().empty();
  });
  if (is_used && !is_used_) read_at_ = settings_.clock->Now();
  is_used_ = is_used;
}

bool VersionLog::IsDue() const {
  const absl::Duration now = settings_.clock->Now();
  return now >= retry_at_ && (now >= read_at_ || has_requests());
}

void VersionLog::Begin() {
  logged_.ForgetOutcomes();
  taken_ = requests_.Take();
}

void VersionLog::Finish(absl::Duration pause) {
  failures_ = 0;
  retry_delay_ = kFirstRetry;
  read_at_ = settings_.clock->Now() + pause;
  std::vector<HeadRequest> again;
  for (HeadRequest& request : taken_) {
    if (request.IsToBeAppended()) {
      again.push_back(std::move(request));
    } else {
      request.OnMerged(logged_.OutcomeOf(request));
    }
  }
  taken_.clear();
  if (!again.empty()) retry_at_ = settings_.clock->Now() + kFirstRetry;
  requests_.PutBack(std::move(again));
}

void VersionLog::Fail(const absl::Status& status, bool is_connected) {
  // JournalStore logs that the store cannot be reached.
  failures_ = is_connected ? failures_ + 1 : 0;
  if (failures_ == kFailuresToLog) {
    LogError("shared heads not taken from their log; tries again",
             {{"policy", logged_.name()}, {"error", status.message()}});
  }
  retry_at_ = settings_.clock->Now() + retry_delay_;
  retry_delay_ = std::min(2 * retry_delay_, kLongestRetry);
  const absl::Status error = WithRetryDelay(
      absl::UnavailableError(absl::StrCat("shared head: ", status.message(), "; try again")),
      kLongestRetry);
  std::vector<HeadRequest> again;
  for (HeadRequest& request : taken_) {
    request.OnError(error);
    if (request.operation == nullptr) again.push_back(std::move(request));
  }
  taken_.clear();
  requests_.PutBack(std::move(again));
}

void VersionLog::Close(const absl::Status& status) {
  while (has_requests()) {
    for (const HeadRequest& request : requests_.Take()) request.OnError(status);
  }
}

void VersionLog::CorrectPause(bool follows) {
  const bool paused = learning_->paused();
  if (paused == logged_.paused() || !follows) {
    pause_since_.reset();
    return;
  }
  const absl::Duration now = settings_.clock->Now();
  if (!pause_since_.has_value()) pause_since_ = now;
  if (now - *pause_since_ < kPausePatience) return;
  pause_since_.reset();
  requests_.Add(NewRequest(PauseKind(paused)));
}

}  // namespace spikeserve
