#include "client/python/engine/played_policy.h"

#include <malloc.h>

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "core/engine/factory/engine_factory.h"
#include "core/model/policy_file.h"
#include "core/session/session_locks.h"
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
  served->fleet = std::make_shared<FleetHead>(policy);
  served->observer = std::make_shared<SessionObserver>();
  return served;
}

absl::Status CheckDifferent(absl::Span<const std::shared_ptr<LocalSession>> sessions) {
  std::vector<const LocalSession*> sorted;
  for (const auto& session : sessions) sorted.push_back(session.get());
  std::sort(sorted.begin(), sorted.end());
  if (std::adjacent_find(sorted.begin(), sorted.end()) == sorted.end()) return absl::OkStatus();
  return absl::InvalidArgumentError(
      "sessions: expected different sessions, received one session twice");
}

}  // namespace

PlayedPolicy::PlayedPolicy(std::shared_ptr<const Engine> engine,
                           std::unique_ptr<const PolicySource> source)
    : served_(Serve(std::move(engine))), source_(std::move(source)) {}

absl::StatusOr<std::shared_ptr<const PlayedPolicy>> PlayedPolicy::Read(const std::string& path) {
  absl::StatusOr<Policy> policy = ReadPolicyFile(path);
  if (!policy.ok()) return policy.status();
  auto engine = MakeStreamingEngine(std::make_shared<const Policy>(*std::move(policy)));
  return std::shared_ptr<const PlayedPolicy>(new PlayedPolicy(std::move(engine), nullptr));
}

absl::StatusOr<std::shared_ptr<const PlayedPolicy>> PlayedPolicy::ReadShared(
    const std::string& path, const std::string& folder) {
  absl::StatusOr<std::unique_ptr<const PolicySource>> source = PolicySource::Open(path);
  if (!source.ok()) return source.status();
  absl::StatusOr<Policy> policy = (*source)->Read();
  if (!policy.ok()) return policy.status();
  auto engine = MakeSharedStreamingEngine(*std::move(policy), folder);
  if (!engine.ok()) return engine.status();
  // The allocator would keep the memory of the file's content and of the matrices.
  malloc_trim(0);
  return std::shared_ptr<const PlayedPolicy>(
      new PlayedPolicy(*std::move(engine), *std::move(source)));
}

absl::StatusOr<Explanation> PlayedPolicy::Explain(const Session& session) const {
  if (source_ == nullptr) return spikeserve::Explain(policy(), session);
  const absl::StatusOr<Policy> complete = source_->Read();
  if (!complete.ok()) return complete.status();
  return spikeserve::Explain(*complete, session);
}

absl::StatusOr<std::shared_ptr<LocalSession>> LocalSession::Open(
    std::shared_ptr<const PlayedPolicy> played, SessionRequest request) {
  absl::StatusOr<SessionOptions> options = ResolveSession(std::move(request), *played->served());
  if (!options.ok()) return options.status();
  return std::make_shared<LocalSession>(std::move(played), NewSession("", *std::move(options)));
}

LocalSession::LocalSession(std::shared_ptr<const PlayedPolicy> played, Session session)
    : played_(std::move(played)),
      entry_(std::make_shared<SessionEntry>(played_->served(), std::move(session),
                                            &played_->clock())) {}

absl::StatusOr<Answer> LocalSession::Act(absl::Span<const float> observation, double reward) {
  const absl::MutexLock lock(&entry_->mutex);
  AgentSession& agent = entry_->agent;
  const absl::StatusOr<const Answer*> answer = agent.Act(agent.session().step, observation, reward);
  if (!answer.ok()) return answer.status();
  return **answer;
}

absl::StatusOr<EpisodeSummary> LocalSession::EndEpisode(const EpisodeEnd& end) {
  const absl::MutexLock lock(&entry_->mutex);
  return entry_->agent.EndEpisode(end);
}

absl::StatusOr<LocalSession::Explained> LocalSession::Explain() {
  Explained explained = {.session = With([](const AgentSession& agent) { return agent.session(); }),
                         .explanation = {}};
  absl::StatusOr<Explanation> explanation = played_->Explain(explained.session);
  if (!explanation.ok()) return explanation.status();
  explained.explanation = *std::move(explanation);
  return explained;
}

absl::StatusOr<std::vector<Answer>> LocalSession::ActTogether(
    absl::Span<const std::shared_ptr<LocalSession>> sessions, absl::Span<const float> observations,
    absl::Span<const double> rewards) {
  std::vector<Answer> answers;
  if (sessions.empty()) return answers;
  if (auto status = CheckDifferent(sessions); !status.ok()) return status;
  std::vector<std::shared_ptr<SessionEntry>> entries;
  for (const auto& session : sessions) entries.push_back(session->entry_);
  const SessionLocks locks(entries);
  std::vector<AgentSession::ActCall> calls;
  const size_t width = observations.size() / sessions.size();
  for (size_t i = 0; i < sessions.size(); ++i) {
    entries[i]->mutex.AssertHeld();
    AgentSession& agent = entries[i]->agent;
    calls.push_back({.session = &agent,
                     .step = agent.session().step,
                     .observation = observations.subspan(i * width, width),
                     .reward = rewards[i]});
    if (auto status = agent.CheckNewDecision(calls.back()); !status.ok()) {
      return absl::Status(status.code(), absl::StrCat("row ", i, ": ", status.message()));
    }
  }
  AgentSession::ActTogether(absl::MakeSpan(calls));
  for (const AgentSession::ActCall& call : calls) {
    if (!call.answer.ok()) return call.answer.status();
    answers.push_back(**call.answer);
  }
  return answers;
}

}  // namespace spikeserve
