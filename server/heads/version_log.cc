#include "server/heads/version_log.h"

#include "absl/strings/str_cat.h"
#include "core/session/session_id.h"
#include "server/base/retry_delay.h"

namespace spikeserve {
namespace {

// How long a call of an operator waits for the log.
constexpr absl::Duration kOperationTimeout = absl::Seconds(5);

constexpr absl::Duration kFirstRetry = absl::Milliseconds(100);

}  // namespace

VersionLog::VersionLog(HeadLogStore* store, const ServedPolicy& served)
    : name(absl::StrCat(served.name, "/", served.version)),
      labels({{"policy", served.name}, {"version", absl::StrCat(served.version)}}),
      keys(served.name, served.version, served.sha256),
      learning(served.learning),
      replica(std::make_shared<TenantHeads>(
          std::shared_ptr<const Policy>(served.engine, &served.policy()))),
      retry_delay(kFirstRetry),
      store_(store) {}

void VersionLog::Append(std::shared_ptr<FleetContribution> contribution) {
  const PendingContribution& pending = contribution->pending();
  const HeadEntry entry = {.kind = HeadEntry::Kind::kMerge,
                           .session = contribution->session(),
                           .episode = pending.episode,
                           .head = contribution->head(),
                           .contributor = contribution->contributor(),
                           .delta = pending.delta,
                           .episode_return = pending.episode_return};
  HeadLogStore::Request request;
  request.append = {.session = entry.session,
                    .episode = entry.episode,
                    .head = entry.head,
                    .bytes = SerializeHeadEntry(entry),
                    .identity = HeadEntryIdentity(entry),
                    .members = {}};
  request.contribution = std::move(contribution);
  store_->Add(this, std::move(request));
}

HeadLogStore::Request VersionLog::NewRequest(HeadEntry::Kind kind, const std::string& head) {
  HeadLogStore::Request request;
  const auto id = NewSessionId();  // any random name
  const HeadEntry entry = {.kind = kind,
                           .session = id.ok() ? *id : "",
                           .head = head,
                           .contributor = "",
                           .delta = {},
                           .episode_return = 0.0};
  request.append = {.session = entry.session,
                    .episode = 0,
                    .head = head,
                    .bytes = id.ok() ? SerializeHeadEntry(entry) : "",
                    .identity = HeadEntryIdentity(entry),
                    .members = {}};
  return request;
}

absl::StatusOr<MergeOutcome> VersionLog::Do(HeadLogStore::Request request) {
  const auto operation = std::make_shared<HeadOperation>();
  request.operation = operation;
  store_->Add(this, std::move(request));
  if (operation->done.WaitFor(kOperationTimeout)) return operation->outcome;
  return WithRetryDelay(
      absl::UnavailableError("session store: has not answered about a shared head; try again"),
      kFirstRetry);
}

absl::Status VersionLog::CatchUp() { return Do({}).status(); }

absl::StatusOr<double> VersionLog::Rollback(const std::string& tenant) {
  if (auto status = CatchUp(); !status.ok()) return status;
  // A tenant that has learned nothing gets no head.
  if (heads()->Find(tenant) == nullptr) return 0.0;
  const auto outcome = Do(NewRequest(HeadEntry::Kind::kRollback, tenant));
  if (!outcome.ok()) return outcome.status();
  return outcome->drift;
}

absl::Status VersionLog::SetPaused(bool paused) {
  return Do(NewRequest(paused ? HeadEntry::Kind::kPause : HeadEntry::Kind::kResume)).status();
}

}  // namespace spikeserve
