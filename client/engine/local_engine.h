// The engine on a robot, for its pilot (spikeserve/pilot.h): goes on with the server's session
// while the server is out of reach, bit for bit.
//
//   PilotOptions options = {.period = absl::Milliseconds(20), .local = LocalEngine::FromServer()};
//
// Thread-safe.
#ifndef CLIENT_ENGINE_LOCAL_ENGINE_H_
#define CLIENT_ENGINE_LOCAL_ENGINE_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/base/clock.h"
#include "core/session/agent_session.h"
#include "core/session/served_policy.h"
#include "spikeserve/local_policy.h"

namespace spikeserve {

class LocalEngine : public LocalPolicy {
 public:
  // Plays the policy file that the server sends with the session.
  static std::shared_ptr<LocalEngine> FromServer();
  // Plays a policy file, or that of the policy and version of the session below a folder:
  // DIR/<policy>/<version>/policy.safetensors. The file is read by Resume.
  static std::shared_ptr<LocalEngine> FromFile(std::string path);

  bool NeedsPolicyFile() const override { return path_.empty(); }
  // Reads the policy unless it was read before. Returns FAILED_PRECONDITION if the server withholds
  // it, or plays another one (SHA-256); NOT_FOUND if there is no such file; INVALID_ARGUMENT or
  // DATA_LOSS if the policy or the value is not valid.
  absl::Status Resume(const v1::ExportSessionResponse& exported) override
      ABSL_LOCKS_EXCLUDED(mutex_);
  // Errors: see AgentSession; FAILED_PRECONDITION before Resume.
  absl::StatusOr<ActionView> Act(int64_t step, absl::Span<const float> observation, double reward,
                                 const std::optional<ActionView>& executed) override
      ABSL_LOCKS_EXCLUDED(mutex_);
  absl::Status EndEpisode(const EpisodeOutcome& outcome, const ActionView& executed) override
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Returns the value of the session, with the bytes of the server's ExportSession.
  absl::StatusOr<std::string> Export() ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  explicit LocalEngine(std::string path) : path_(std::move(path)) {}

  // Reads the policy with the SHA-256 of `exported`.
  absl::Status Load(const v1::ExportSessionResponse& exported)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const std::string path_;  // empty: from the server
  const SteadyClock clock_;
  absl::Mutex mutex_;
  std::shared_ptr<const ServedPolicy> served_ ABSL_GUARDED_BY(mutex_);  // null: not read
  std::optional<AgentSession> agent_ ABSL_GUARDED_BY(mutex_);
  Action action_ ABSL_GUARDED_BY(mutex_);  // the last decision
};

}  // namespace spikeserve

#endif  // CLIENT_ENGINE_LOCAL_ENGINE_H_
