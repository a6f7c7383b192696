// The log of one policy version, as a HeadLogStore keeps it.
#ifndef SERVER_HEADS_VERSION_LOG_H_
#define SERVER_HEADS_VERSION_LOG_H_

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/agent/head_log.h"
#include "core/agent/served_policy.h"
#include "core/base/steady_wait.h"
#include "server/heads/head_entry.h"
#include "server/heads/head_log_store.h"
#include "server/heads/head_replica.h"
#include "server/heads/redis_head_log.h"

namespace spikeserve {

// What a thread waits for that asks for an entry, or for the log to be read.
struct HeadOperation {
  SteadyNotification done;
  absl::StatusOr<MergeOutcome> outcome;  // set before `done`
};

struct HeadLogStore::Request {
  HeadAppend append;  // without bytes: the log is only read
  std::shared_ptr<FleetContribution> contribution;
  std::shared_ptr<HeadOperation> operation;
  bool is_sent = false;  // an attempt to append it may have succeeded
  bool is_in_log = false;
  bool is_new = false;  // this server has appended it
};

class VersionLog final : public HeadLog {
 public:
  // `store` must outlive the log.
  VersionLog(HeadLogStore* store, const ServedPolicy& served);

  std::shared_ptr<TenantHeads> heads() const override { return replica.heads(); }
  void Append(std::shared_ptr<FleetContribution> contribution) override;
  absl::Status CatchUp() override;
  absl::StatusOr<double> Rollback(const std::string& tenant) override;
  absl::Status SetPaused(bool paused) override;

  // Returns a request for an entry without a session.
  static HeadLogStore::Request NewRequest(HeadEntry::Kind kind, const std::string& head = "");

  // Of the store's thread:
  const std::string name;           // of the version, for people
  const prometheus::Labels labels;  // policy and version
  const HeadLogKeys keys;
  const std::shared_ptr<LearningSwitch> learning;
  HeadReplica replica;
  bool has_joined = false;
  int64_t snapshot_number = 0;
  bool wants_snapshot = false;
  int failures = 0;        // since the log was read last, on a connection that was made
  absl::Duration read_at;  // the next time without requests
  absl::Duration retry_at;
  absl::Duration retry_delay;
  bool is_used = false;                       // a session on this server uses a head
  absl::Duration members_kept;                // when
  std::optional<absl::Duration> gap_since;    // the stored log has a gap
  std::optional<absl::Duration> pause_since;  // the log and the settings differ in the pause
  // Outcomes of entries that were folded since the requests were taken.
  std::map<std::pair<std::string, int64_t>, MergeOutcome> outcomes;

  // Guarded by the store's mutex:
  std::vector<HeadLogStore::Request> requests;

 private:
  // Waits for the outcome of a request.
  absl::StatusOr<MergeOutcome> Do(HeadLogStore::Request request);

  HeadLogStore* const store_;
};

}  // namespace spikeserve

#endif  // SERVER_HEADS_VERSION_LOG_H_
