#include "client/python/engine/played_policy.h"

#include <fcntl.h>
#include <malloc.h>
#include <unistd.h>

#include <algorithm>
#include <functional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "core/journal/journal_entry.h"
#include "core/journal/session_export.h"
#include "core/model/policy_file.h"
#include "core/model/safetensors.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

constexpr char kName[] = "policy";  // sessions need a name, but only a server has several policies

std::shared_ptr<const ServedPolicy> Serve(std::shared_ptr<const Engine> engine) {
  const std::shared_ptr<const Policy> policy(engine, &engine->policy());
  auto served = std::make_shared<ServedPolicy>();
  served->name = kName;
  served->version = 1;
  served->engine = std::move(engine);
  served->heads = std::make_shared<TenantHeads>(policy);
  served->observer = std::make_shared<SessionObserver>();
  return served;
}

}  // namespace

absl::StatusOr<std::unique_ptr<const PolicySource>> PolicySource::Open(const std::string& path) {
  const int descriptor = open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (descriptor < 0) {
    return absl::NotFoundError(absl::StrCat(path, ": expected a file that can be read"));
  }
  std::unique_ptr<PolicySource> source(new PolicySource(path, descriptor));
  ASSIGN_OR_RETURN(const std::string bytes, source->ReadBytes());
  source->hash_ = std::hash<std::string>()(bytes);
  return std::unique_ptr<const PolicySource>(std::move(source));
}

PolicySource::PolicySource(std::string path, int descriptor)
    : path_(std::move(path)), descriptor_(descriptor) {}

PolicySource::~PolicySource() { close(descriptor_); }

absl::StatusOr<Policy> PolicySource::Read() const {
  ASSIGN_OR_RETURN(const std::string bytes, ReadBytes());
  if (std::hash<std::string>()(bytes) != hash_) {
    return absl::FailedPreconditionError(absl::StrCat(
        path_, ": expected the content that the engine plays, received other content"));
  }
  absl::StatusOr<Policy> policy = ParsePolicyFile(bytes);
  if (!policy.ok()) return Annotate(policy.status(), path_);
  return policy;
}

absl::StatusOr<std::string> PolicySource::ReadBytes() const {
  // Opens the same file once more, whatever its name is now.
  absl::StatusOr<std::string> bytes =
      ReadSafetensorsFile(absl::StrCat("/proc/self/fd/", descriptor_));
  if (!bytes.ok()) return Annotate(bytes.status(), path_);
  return bytes;
}

PlayedPolicy::PlayedPolicy(std::shared_ptr<const Engine> engine,
                           std::unique_ptr<const PolicySource> source)
    : served_(Serve(std::move(engine))), source_(std::move(source)) {}

absl::StatusOr<std::shared_ptr<const PlayedPolicy>> PlayedPolicy::Read(const std::string& path) {
  ASSIGN_OR_RETURN(Policy policy, ReadPolicyFile(path));
  auto engine = MakeEngine(std::make_shared<const Policy>(std::move(policy)));
  return std::shared_ptr<const PlayedPolicy>(new PlayedPolicy(std::move(engine), nullptr));
}

absl::StatusOr<std::shared_ptr<const PlayedPolicy>> PlayedPolicy::ReadShared(
    const std::string& path, const std::string& folder) {
  ASSIGN_OR_RETURN(std::unique_ptr<const PolicySource> source, PolicySource::Open(path));
  ASSIGN_OR_RETURN(Policy policy, source->Read());
  ASSIGN_OR_RETURN(auto engine, MakeEngine(std::move(policy), folder));
  // The allocator would keep the memory of the file's content and of the matrices.
  malloc_trim(0);
  return std::shared_ptr<const PlayedPolicy>(
      new PlayedPolicy(std::move(engine), std::move(source)));
}

absl::StatusOr<Explanation> PlayedPolicy::Explain(const Session& session) const {
  if (source_ == nullptr) return spikeserve::Explain(policy(), session);
  ASSIGN_OR_RETURN(const Policy complete, source_->Read());
  return spikeserve::Explain(complete, session);
}

absl::StatusOr<std::shared_ptr<LocalSession>> LocalSession::Open(
    std::shared_ptr<const PlayedPolicy> played, SessionRequest request) {
  ASSIGN_OR_RETURN(SessionOptions options, ResolveSession(std::move(request), *played->served()));
  return std::make_shared<LocalSession>(std::move(played), NewSession("", std::move(options)));
}

absl::StatusOr<std::shared_ptr<LocalSession>> LocalSession::Resume(
    std::shared_ptr<const PlayedPolicy> played, absl::string_view value) {
  absl::StatusOr<Session> session = ImportSession(value);
  if (!session.ok()) return session.status();
  // A journal without entries: the session, after the checks that it belongs to the policy.
  session = RestoreSession({.snapshot = *std::move(session), .entries = {}}, played->policy());
  if (!session.ok()) return session.status();
  return std::make_shared<LocalSession>(std::move(played), *std::move(session));
}

LocalSession::LocalSession(std::shared_ptr<const PlayedPolicy> played, Session session)
    : played_(std::move(played)),
      agent_(played_->served(), std::move(session), &played_->clock()) {}

// Clang's thread-safety analysis cannot follow locks in a container, so the user of a session
// asserts its lock.
class LocalSession::Locks {
 public:
  // REQUIRES: the sessions are different, and sorted by address.
  explicit Locks(absl::Span<LocalSession* const> sorted) ABSL_NO_THREAD_SAFETY_ANALYSIS
      : sorted_(sorted) {
    for (LocalSession* session : sorted_) session->mutex_.Lock();
  }
  ~Locks() ABSL_NO_THREAD_SAFETY_ANALYSIS {
    for (LocalSession* session : sorted_) session->mutex_.Unlock();
  }
  Locks(const Locks&) = delete;
  Locks& operator=(const Locks&) = delete;

 private:
  const absl::Span<LocalSession* const> sorted_;
};

absl::StatusOr<Answer> LocalSession::Act(absl::Span<const float> observation, double reward,
                                         const std::optional<ReportedAction>& executed) {
  const absl::MutexLock lock(&mutex_);
  ASSIGN_OR_RETURN(const Answer* answer,
                   agent_.Act(/*step=*/std::nullopt, observation, reward, executed));
  return *answer;
}

absl::Status LocalSession::Skip(double reward, const std::optional<ReportedAction>& executed) {
  const absl::MutexLock lock(&mutex_);
  return agent_.AddBlindStep(reward, executed);
}

int64_t LocalSession::step() {
  const absl::MutexLock lock(&mutex_);
  return agent_.next_step();
}

absl::StatusOr<EpisodeSummary> LocalSession::EndEpisode(
    const EpisodeEnd& end, const std::optional<ReportedAction>& executed) {
  const absl::MutexLock lock(&mutex_);
  return agent_.EndEpisode(end, executed);
}

std::string LocalSession::Export() {
  return With([](const AgentSession& agent) { return ExportSession(agent); });
}

absl::StatusOr<LocalSession::Explained> LocalSession::Explain() {
  Explained explained = {.session = With([](const AgentSession& agent) { return agent.session(); }),
                         .explanation = {}};
  ASSIGN_OR_RETURN(explained.explanation, played_->Explain(explained.session));
  return explained;
}

absl::StatusOr<BatchAnswers> LocalSession::ActTogether(absl::Span<LocalSession* const> sessions,
                                                       absl::Span<const float> observations,
                                                       absl::Span<const double> rewards) {
  BatchAnswers answers;
  if (sessions.empty()) return answers;
  std::vector<LocalSession*> sorted(sessions.begin(), sessions.end());
  std::sort(sorted.begin(), sorted.end());
  if (std::adjacent_find(sorted.begin(), sorted.end()) != sorted.end()) {
    return absl::InvalidArgumentError(
        "sessions: expected different sessions, received one session twice");
  }
  const Locks locks(sorted);
  std::vector<Step> steps(sessions.size());
  std::vector<Step*> all(sessions.size());
  const size_t width = observations.size() / sessions.size();
  for (size_t i = 0; i < sessions.size(); ++i) {
    sessions[i]->mutex_.AssertHeld();
    AgentSession& agent = sessions[i]->agent_;
    if (const int64_t skipped = agent.next_step() - agent.session().step; skipped > 0) {
      return absl::FailedPreconditionError(absl::StrCat(
          "row ", i, ": expected a session without skipped steps, received one with ", skipped));
    }
    steps[i].session = &agent;
    steps[i].observation = observations.subspan(i * width, width);
    steps[i].reward = rewards[i];
    all[i] = &steps[i];
    if (auto status = agent.CheckNewDecision(steps[i]); !status.ok()) {
      return absl::Status(status.code(), absl::StrCat("row ", i, ": ", status.message()));
    }
  }
  AgentSession::Apply(all);
  answers.Reserve(steps.size());
  for (const Step& step : steps) {
    if (!step.result.status.ok()) return step.result.status;
    answers.Append(*step.result.answer);
  }
  return answers;
}

}  // namespace spikeserve
