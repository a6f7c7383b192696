// Plays one policy file in this process, without a server.
//
//   auto policy = PlayedPolicy::Read("policy.safetensors");
//   auto session = LocalSession::Open(*policy, SessionRequest());
//   absl::StatusOr<Answer> answer = (*session)->Act(observation, /*reward=*/0.0);
//
// Thread-safe: a session admits one call at a time, different sessions are independent. Answers are
// equal, bit for bit, to those of the server for the same requests.
#pragma once

#include <cstddef>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/synchronization/mutex.h"
#include "absl/types/span.h"
#include "client/python/engine/batch_answers.h"
#include "core/action/reported_action.h"
#include "core/agent/agent_session.h"
#include "core/agent/explanation.h"
#include "core/agent/served_policy.h"
#include "core/agent/session_request.h"
#include "core/base/clock.h"

namespace spikeserve {

// Reads one policy file several times, also after another file has taken its name. Thread-safe.
// Holds a file descriptor.
class PolicySource {
 public:
  // NOT_FOUND if there is no such file.
  static absl::StatusOr<std::unique_ptr<const PolicySource>> Open(const std::string& path);

  ~PolicySource();
  PolicySource(const PolicySource&) = delete;
  PolicySource& operator=(const PolicySource&) = delete;

  // Errors: see ReadPolicyFile. FAILED_PRECONDITION if the content has changed since Open.
  absl::StatusOr<Policy> Read() const;

 private:
  PolicySource(std::string path, int descriptor);

  absl::StatusOr<std::string> ReadBytes() const;

  const std::string path_;
  const int descriptor_;
  size_t hash_ = 0;  // of the content
};

// A policy with its engine, and the head that its fleet sessions share. Immutable apart from that
// head.
class PlayedPolicy {
 public:
  // Errors: see ReadPolicyFile.
  static absl::StatusOr<std::shared_ptr<const PlayedPolicy>> Read(const std::string& path);
  // As above, with the weight matrices in memory that processes share. Errors: see also
  // MakeEngine.
  static absl::StatusOr<std::shared_ptr<const PlayedPolicy>> ReadShared(const std::string& path,
                                                                        const std::string& folder);

  // Without weight matrices, if they are shared.
  const Policy& policy() const { return served_->policy(); }
  // Explains a decision of a session. Reads shared matrices from the file again.
  absl::StatusOr<Explanation> Explain(const Session& session) const;
  const std::shared_ptr<const ServedPolicy>& served() const { return served_; }
  const Clock& clock() const { return clock_; }

 private:
  PlayedPolicy(std::shared_ptr<const Engine> engine, std::unique_ptr<const PolicySource> source);

  std::shared_ptr<const ServedPolicy> served_;
  std::unique_ptr<const PolicySource> source_;  // null if the engine's policy is complete
  SteadyClock clock_;
};

// One agent's session. Always decides at the step that it expects next, so no call is a retry.
class LocalSession {
 public:
  // Errors: see ResolveSession.
  static absl::StatusOr<std::shared_ptr<LocalSession>> Open(
      std::shared_ptr<const PlayedPolicy> played, SessionRequest request);

  // Continues a session that a server, or Export, has exported. Returns INVALID_ARGUMENT if `value`
  // is not one, and DATA_LOSS if it does not belong to a session of the policy.
  static absl::StatusOr<std::shared_ptr<LocalSession>> Resume(
      std::shared_ptr<const PlayedPolicy> played, absl::string_view value);

  LocalSession(std::shared_ptr<const PlayedPolicy> played, Session session);

  const PlayedPolicy& played() const { return *played_; }
  const Policy& policy() const { return played_->policy(); }

  // Errors of the methods: see AgentSession.
  absl::StatusOr<Answer> Act(absl::Span<const float> observation, double reward,
                             const std::optional<ReportedAction>& executed = std::nullopt);
  // Takes a step whose observation is not known; see AgentSession::AddBlindStep.
  absl::Status Skip(double reward, const std::optional<ReportedAction>& executed);
  // Returns the next step.
  int64_t step();
  absl::StatusOr<EpisodeSummary> EndEpisode(const EpisodeEnd& end,
                                            const std::optional<ReportedAction>& executed);
  // A recomputed decision, and the value of the session that made it.
  struct Explained {
    Session session;
    Explanation explanation;
  };
  // Takes about a thousand times as long as a decision. Holds the lock only for a copy.
  absl::StatusOr<Explained> Explain();

  // Returns the value of the session, with the bytes of the server's ExportSession.
  std::string Export();

  // Calls `read` with the session while no other call changes it.
  template <typename Read>
  auto With(Read read) {
    const absl::MutexLock lock(&mutex_);
    return read(static_cast<const AgentSession&>(agent_));
  }

  // Decides for several different sessions of one policy at once; row i of `observations` [rows *
  // obs] and `rewards`[i] belong to sessions[i]. On an error, no session changes.
  static absl::StatusOr<BatchAnswers> ActTogether(absl::Span<LocalSession* const> sessions,
                                                  absl::Span<const float> observations,
                                                  absl::Span<const double> rewards);

 private:
  // Locks several sessions in one order for all threads.
  class Locks;

  const std::shared_ptr<const PlayedPolicy> played_;
  absl::Mutex mutex_;
  AgentSession agent_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace spikeserve
