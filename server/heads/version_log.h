// The log of one policy version for those who append to it, and when it is read.
#ifndef SERVER_HEADS_VERSION_LOG_H_
#define SERVER_HEADS_VERSION_LOG_H_

#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "core/agent/head_log.h"
#include "core/agent/served_policy.h"
#include "core/store/redis_client.h"
#include "server/heads/head_requests.h"
#include "server/heads/logged_heads.h"

namespace spikeserve {

// The methods of HeadLog are thread-safe: they queue a request, and wait for it if they have an
// outcome. The other methods are called by one thread, which serves the log.
class VersionLog final : public HeadLog {
 public:
  // `settings` must outlive the log. `wake` is called when the log has requests.
  VersionLog(const HeadLogSettings* settings, const ServedPolicy& served,
             std::function<void()> wake);

  std::shared_ptr<TenantHeads> heads() const override { return logged_.heads(); }
  void Append(std::shared_ptr<FleetContribution> contribution) override;
  absl::Status CatchUp() override;
  absl::StatusOr<double> Rollback(const std::string& tenant) override;
  absl::Status SetPaused(bool paused) override;

  // Thread-safe, too.
  bool has_requests() const { return !requests_.empty(); }

  bool has_joined() const { return logged_.has_joined(); }
  // Returns whether a session on this server used a head when NoteUse() was called last.
  bool is_used() const { return is_used_; }
  // Finds out whether one does now. The log is due when that begins.
  void NoteUse();
  // Returns true if the log is to be served now.
  bool IsDue() const;

  // Serving the log: Begin() takes the requests, any number of calls of Exchange() appends them and
  // folds what the log has, and Finish() or Fail() ends it.
  void Begin();
  absl::Status Exchange(RedisClient& client) {
    return logged_.Exchange(client, absl::MakeSpan(taken_));
  }
  // The last Exchange() returned OK. Reports the outcomes. What a log does not take now that was
  // written again is tried again later. Without requests the log is due again after `pause`.
  void Finish(absl::Duration pause);
  // The log could not be served, because of `status`. Requests without an operation are tried again
  // later. `is_connected`: Redis could be reached before.
  void Fail(const absl::Status& status, bool is_connected);
  // Ends all requests with an error, because nothing will serve the log again.
  void Close(const absl::Status& status);

  // Asks for an entry if the log has missed a pause, or its end, that operators have set some
  // seconds ago. `follows`: this server knows their settings at present.
  void CorrectPause(bool follows);

 private:
  // Waits for the outcome of a request.
  absl::StatusOr<MergeOutcome> Do(HeadRequest request);

  const HeadLogSettings& settings_;
  const std::shared_ptr<LearningSwitch> learning_;
  HeadRequests requests_;
  LoggedHeads logged_;
  std::vector<HeadRequest> taken_;  // from Begin() to Finish() or Fail()
  bool is_used_ = false;
  int failures_ = 0;         // since the log was read last, on a connection that was made
  absl::Duration read_at_;   // the next time without requests
  absl::Duration retry_at_;  // not before
  absl::Duration retry_delay_;
  std::optional<absl::Duration> pause_since_;  // the log and the settings differ in the pause
};

}  // namespace spikeserve

#endif  // SERVER_HEADS_VERSION_LOG_H_
