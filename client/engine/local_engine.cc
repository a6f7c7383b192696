#include "spikeserve/local_engine.h"

#include <cstdint>
#include <filesystem>
#include <optional>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"
#include "core/action/reported_action.h"
#include "core/agent/agent_session.h"
#include "core/agent/served_policy.h"
#include "core/base/clock.h"
#include "core/base/file.h"
#include "core/base/status_macros.h"
#include "core/digest/sha256.h"
#include "core/engine/factory/engine_factory.h"
#include "core/journal/journal_entry.h"
#include "core/journal/session_export.h"
#include "core/model/policy_file.h"

namespace spikeserve {
namespace {

// Returns the path of the policy file of a session.
std::string PathFor(const std::string& path, const v1::ExportSessionResponse& exported) {
  std::error_code ignored;  // a path that is no folder is tried as a file
  if (!std::filesystem::is_directory(path, ignored)) return path;
  return absl::StrCat(path, "/", exported.policy(), "/", exported.version(), "/policy.safetensors");
}

ReportedAction Reported(const ActionView& action, const ActionSpace& space) {
  ReportedAction reported = action.continuous;
  if (space.is_discrete()) reported = action.discrete;
  reported.source = {.kind = action.by.kind, .operator_id = action.by.operator_id};
  return reported;
}

// The engine itself, which the header does not show: an installed client has no headers of core.
class Player final : public LocalEngine {
 public:
  explicit Player(std::string path) : path_(std::move(path)) {}

  bool NeedsPolicyFile() const override { return path_.empty(); }
  absl::Status Resume(const v1::ExportSessionResponse& exported) override
      ABSL_LOCKS_EXCLUDED(mutex_) {
    ASSIGN_OR_RETURN(Session session, ImportSession(exported.value()));
    absl::MutexLock lock(&mutex_);
    if (served_ == nullptr || served_->sha256 != exported.policy_sha256()) {
      RETURN_IF_ERROR(Load(exported));
    }
    // A journal without entries: the session, after the checks that it belongs to the policy.
    ASSIGN_OR_RETURN(session, RestoreSession({.snapshot = std::move(session), .entries = {}},
                                             served_->policy()));
    agent_.reset();
    agent_.emplace(served_, std::move(session), &clock_);
    return absl::OkStatus();
  }

  absl::StatusOr<ActionView> Act(int64_t step, absl::Span<const float> observation, double reward,
                                 const std::optional<ActionView>& executed) override
      ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (!agent_.has_value()) return absl::FailedPreconditionError("local: there is no session");
    std::optional<ReportedAction> reported;
    if (executed.has_value()) reported = Reported(*executed, served_->policy().action_space);
    if (observation.empty()) {
      RETURN_IF_ERROR(agent_->AddBlindStep(reward, reported));
      return ActionView();
    }
    if (step != agent_->next_step()) {
      return absl::FailedPreconditionError(
          absl::StrCat("step: expected ", agent_->next_step(), ", received ", step));
    }
    ASSIGN_OR_RETURN(const auto answer,
                     agent_->Act(/*step=*/std::nullopt, observation, reward, reported));
    action_ = answer->action;
    return ActionView{.discrete = action_.discrete, .continuous = action_.continuous};
  }

  absl::Status EndEpisode(const EpisodeOutcome& outcome, const ActionView& executed) override
      ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (!agent_.has_value()) return absl::FailedPreconditionError("local: there is no session");
    return agent_
        ->EndEpisode({.reward = outcome.reward,
                      .terminated = outcome.terminated,
                      .target_return = outcome.target_return,
                      .truncated = outcome.truncated,
                      .observation = outcome.observation},
                     Reported(executed, served_->policy().action_space))
        .status();
  }

  absl::StatusOr<std::string> Export() override ABSL_LOCKS_EXCLUDED(mutex_) {
    absl::MutexLock lock(&mutex_);
    if (!agent_.has_value()) return absl::FailedPreconditionError("local: there is no session");
    return ExportSession(*agent_);
  }

 private:
  // Reads the policy with the SHA-256 of `exported`.
  absl::Status Load(const v1::ExportSessionResponse& exported)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    std::string content = exported.policy_file();
    if (!path_.empty()) {
      ASSIGN_OR_RETURN(content, ReadFile(PathFor(path_, exported)));
    }
    if (content.empty()) {
      return absl::FailedPreconditionError(
          "local: expected the policy file from the server, received none; it may withhold it");
    }
    const std::string digest = Sha256Of(content);
    if (digest != exported.policy_sha256()) {
      return absl::FailedPreconditionError(
          absl::StrCat("local: expected the policy file with SHA-256 ", exported.policy_sha256(),
                       " that the server plays, received one with ", digest));
    }
    ASSIGN_OR_RETURN(Policy policy, ParsePolicyFile(content));
    const auto shared = std::make_shared<const Policy>(std::move(policy));
    auto served = std::make_shared<ServedPolicy>();
    served->name = exported.policy();
    served->version = exported.version();
    served->sha256 = digest;
    served->engine = MakeEngine(shared);
    served->heads = std::make_shared<TenantHeads>(shared);
    served->observer = std::make_shared<SessionObserver>();
    served_ = std::move(served);
    return absl::OkStatus();
  }

  const std::string path_;  // empty: from the server
  const SteadyClock clock_;
  absl::Mutex mutex_;
  std::shared_ptr<const ServedPolicy> served_ ABSL_GUARDED_BY(mutex_);  // null: not read
  std::optional<AgentSession> agent_ ABSL_GUARDED_BY(mutex_);
  Action action_ ABSL_GUARDED_BY(mutex_);  // the last decision
};

}  // namespace

std::shared_ptr<LocalEngine> LocalEngine::FromServer() { return FromFile(""); }

std::shared_ptr<LocalEngine> LocalEngine::FromFile(std::string path) {
  return std::make_shared<Player>(std::move(path));
}

}  // namespace spikeserve
