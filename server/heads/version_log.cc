#include "server/heads/version_log.h"

#include <algorithm>
#include <iterator>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/base/steady_wait.h"
#include "core/session/session_id.h"
#include "server/base/log.h"
#include "server/base/retry_delay.h"

namespace spikeserve {
namespace {

// Entries that are appended together.
constexpr ptrdiff_t kMostAppends = 16;

// How long a call of an operator waits for the log.
constexpr absl::Duration kOperationTimeout = absl::Seconds(5);

constexpr absl::Duration kFirstRetry = absl::Milliseconds(100);
constexpr absl::Duration kLongestRetry = absl::Seconds(1);

// How often this server looks whether its sessions use the heads of a log. What it has read of the
// log is as old as this, at most, when a session has begun to.
constexpr absl::Duration kUseInterval = absl::Seconds(1);

// A connection that breaks fails once. What fails again has another cause, which is logged.
constexpr int kFailuresToLog = 2;

// How long the settings and a log may differ in a pause: longer than a change of the settings takes
// to reach this server.
constexpr absl::Duration kPausePatience = absl::Seconds(5);

HeadEntry::Kind PauseKind(bool paused) {
  return paused ? HeadEntry::Kind::kPause : HeadEntry::Kind::kResume;
}

}  // namespace

VersionLog::VersionLog(const HeadLogSettings* settings, const ServedPolicy& served,
                       std::function<void()> wake)
    : settings_(*settings),
      policy_(served.name),
      version_(served.version),
      name_(absl::StrCat(served.name, "/", served.version)),
      learning_(served.learning),
      wake_(std::move(wake)),
      redis_(served.name, served.version, served.sha256, settings->retention),
      fold_(std::make_shared<TenantHeads>(
          std::shared_ptr<const Policy>(served.engine, &served.policy()))),
      retry_delay_(kFirstRetry) {}

VersionLog::Request VersionLog::NewRequest(HeadEntry::Kind kind, Contribution contribution) {
  const auto id = NewSessionId();  // any random name
  contribution.session = id.value_or("");
  HeadEntry entry = {.kind = kind, .contribution = std::move(contribution)};
  std::string bytes = id.ok() ? SerializeHeadEntry(entry) : "";
  return {.entry = std::move(entry), .bytes = std::move(bytes), .done = [](const auto&, bool) {}};
}

void VersionLog::Append(std::shared_ptr<FleetContribution> contribution) {
  HeadEntry entry = {.contribution = contribution->value()};
  std::string bytes = SerializeHeadEntry(entry);
  Add({.entry = std::move(entry),
       .bytes = std::move(bytes),
       .done = [contribution = std::move(contribution)](
                   const auto& outcome, bool is_new) { contribution->OnOutcome(outcome, is_new); },
       .is_kept = true});
}

absl::StatusOr<MergeOutcome> VersionLog::Do(Request request) {
  struct Operation {
    SteadyNotification done;
    absl::StatusOr<MergeOutcome> outcome;  // set before `done`
  };
  const auto operation = std::make_shared<Operation>();
  request.done = [operation](const auto& outcome, bool /*is_new*/) {
    operation->outcome = outcome;
    operation->done.Notify();
  };
  Add(std::move(request));
  if (operation->done.WaitFor(kOperationTimeout)) return operation->outcome;
  return WithRetryDelay(
      absl::UnavailableError("session store: has not answered about a shared head; try again"),
      kFirstRetry);
}

absl::Status VersionLog::CatchUp() { return Do(Request()).status(); }

absl::StatusOr<double> VersionLog::Rollback(const std::string& tenant) {
  RETURN_IF_ERROR(CatchUp());
  // A tenant that has learned nothing gets no head.
  if (heads()->Find(tenant) == nullptr) return 0.0;
  ASSIGN_OR_RETURN(const auto outcome,
                   Do(NewRequest(HeadEntry::Kind::kRollback, {.head = tenant})));
  return outcome.drift;
}

absl::StatusOr<MergeOutcome> VersionLog::Undo(const std::string& tenant,
                                              const std::string& operator_id, absl::Duration ago) {
  RETURN_IF_ERROR(CatchUp());
  if (heads()->Find(tenant) == nullptr) return MergeOutcome();
  return Do(NewRequest(
      HeadEntry::Kind::kUndo,
      {.head = tenant, .operators = {operator_id}, .episode_return = absl::ToDoubleSeconds(ago)}));
}

absl::Status VersionLog::SetPaused(bool paused) {
  return Do(NewRequest(PauseKind(paused))).status();
}

void VersionLog::Add(Request request) {
  {
    absl::MutexLock lock(&mutex_);
    requests_.push_back(std::move(request));
  }
  wake_();
}

void VersionLog::Take() {
  if (!taken_.empty()) return;
  {
    absl::MutexLock lock(&mutex_);
    const auto end = requests_.begin() + std::min(std::ssize(requests_), kMostAppends);
    std::move(requests_.begin(), end, std::back_inserter(taken_));
    requests_.erase(requests_.begin(), end);
  }
  if (std::ssize(taken_) == kMostAppends) wake_();  // there may be more
}

void VersionLog::PutBack(Requests requests) {
  absl::MutexLock lock(&mutex_);
  std::move(requests_.begin(), requests_.end(), std::back_inserter(requests));
  requests_ = std::move(requests);
}

bool VersionLog::has_requests() const {
  absl::MutexLock lock(&mutex_);
  return !requests_.empty();
}

bool VersionLog::IsDue() {
  const absl::Duration now = settings_.clock->Now();
  if (now - use_noted_ >= kUseInterval) {
    use_noted_ = now;
    const auto tenants = heads()->Tenants();
    const bool was_used = std::exchange(
        is_used_, std::any_of(tenants.begin(), tenants.end(), [&](const auto& tenant) {
          return !heads()->Of(tenant)->Members().empty();
        }));
    if (is_used_ && !was_used) read_at_ = now;
  }
  return now >= retry_at_ && (now >= read_at_ || has_requests());
}

void VersionLog::Finish(absl::Duration pause, bool follows) {
  failures_ = 0;
  retry_delay_ = kFirstRetry;
  read_at_ = settings_.clock->Now() + pause;
  Requests again;
  for (Request& request : std::exchange(taken_, {})) {
    if (request.IsToBeAppended()) {
      again.push_back(std::move(request));
    } else {
      request.done(OutcomeOf(request), request.is_new);
    }
  }
  fold_.ForgetOutcomes();
  if (!again.empty()) retry_at_ = settings_.clock->Now() + kFirstRetry;
  PutBack(std::move(again));
  CorrectPause(follows);
}

void VersionLog::Fail(const absl::Status& status, bool is_connected) {
  // JournalStore logs that the store cannot be reached.
  failures_ = is_connected ? failures_ + 1 : 0;
  if (failures_ == kFailuresToLog) {
    LogError("shared heads not taken from their log; tries again",
             {{"policy", name_}, {"error", status.message()}});
  }
  retry_at_ = settings_.clock->Now() + retry_delay_;
  retry_delay_ = std::min(2 * retry_delay_, kLongestRetry);
  const absl::Status error = WithRetryDelay(
      absl::UnavailableError(absl::StrCat("shared head: ", status.message(), "; try again")),
      kLongestRetry);
  Take();
  Requests again;
  for (Request& request : std::exchange(taken_, {})) {
    request.done(error, false);
    if (request.is_kept) again.push_back(std::move(request));
  }
  PutBack(std::move(again));
}

void VersionLog::Close(const absl::Status& status) {
  for (Take(); !taken_.empty(); Take()) {
    for (const Request& request : std::exchange(taken_, {})) request.done(status, false);
  }
}

void VersionLog::CorrectPause(bool follows) {
  const bool paused = learning_->paused();
  if (paused == fold_.paused() || !follows) {
    pause_since_.reset();
    return;
  }
  const absl::Duration now = settings_.clock->Now();
  if (!pause_since_.has_value()) pause_since_ = now;
  if (now - *pause_since_ < kPausePatience) return;
  pause_since_.reset();
  Request request = NewRequest(PauseKind(paused));
  request.is_kept = true;
  Add(std::move(request));
}

}  // namespace spikeserve
