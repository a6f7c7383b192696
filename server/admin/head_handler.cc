#include "server/admin/head_handler.h"

#include <algorithm>
#include <cstdint>
#include <filesystem>
#include <string>
#include <system_error>

#include "absl/strings/str_cat.h"
#include "core/learning/frobenius_norm.h"
#include "core/learning/learner.h"
#include "core/model/policy_file.h"
#include "nlohmann/json.hpp"
#include "server/admin/traffic.h"
#include "server/policies/policy_repository.h"

namespace spikeserve {
namespace {

using nlohmann::json;

// Returns the policy with the shared head as its action head. Its training record holds the lineage
// of the head and, as `parent_training`, the record of the parent, whose evaluation does not apply
// to the new head.
Policy Promoted(const ServedPolicy& served, const FleetHead::Snapshot& snapshot) {
  Policy policy = served.policy();
  policy.weights.head = snapshot.head;
  const json lineage = {{"parent_version", served.version},
                        {"updates", snapshot.updates},
                        {"base_norm", BaseNorm(served.policy())},
                        {"delta_norm", FrobeniusNorm(snapshot.delta)},
                        {"drift", snapshot.drift},
                        {"watched_return", snapshot.level.mean}};
  policy.training =
      json{{"promoted", lineage}, {"parent_training", json::parse(served.policy().training)}}
          .dump();
  return policy;
}

// Returns the highest version in the directory plus one, so that no existing folder is overwritten.
absl::StatusOr<int64_t> NextVersion(const std::string& directory, const std::string& policy) {
  const auto folders = ListPolicyFolders(directory);
  if (!folders.ok()) return folders.status();
  int64_t highest = 0;
  for (const PolicyVersion& version : folders->versions) {
    if (version.policy == policy) highest = std::max(highest, version.version);
  }
  return highest + 1;
}

absl::Status WriteNewVersion(const Policy& policy, const std::string& path) {
  std::error_code error;
  std::filesystem::create_directory(std::filesystem::path(path).parent_path(), error);
  if (error) return absl::FailedPreconditionError(absl::StrCat(path, ": ", error.message()));
  return WritePolicyFile(policy, path);
}

}  // namespace

absl::Status HeadHandler::GetHead(const v1::GetHeadRequest& request,
                                  v1::GetHeadResponse* response) const {
  const auto served = registry_->catalog()->Find(request.policy(), request.version());
  if (!served.ok()) return served.status();
  const Policy& policy = (*served)->policy();
  const auto snapshot = (*served)->fleet->Read();
  response->set_policy((*served)->name);
  response->set_version((*served)->version);
  response->set_base_norm(BaseNorm(policy));
  response->set_delta_norm(FrobeniusNorm(snapshot->delta));
  response->set_drift(snapshot->drift);
  response->set_updates(snapshot->updates);
  response->set_rejected_updates(snapshot->rejected);
  response->set_rollbacks(snapshot->rollbacks);
  response->set_watched_return(snapshot->level.mean);
  response->set_paused((*served)->learning->paused());
  const auto on_it =
      store_->List([&](const SessionEntry& entry) { return entry.served == *served; });
  for (const ListedSession& session : on_it) {
    absl::MutexLock lock(&session.entry->mutex);
    const auto& learning = session.entry->agent.session().options.learning;
    if (learning.has_value() && learning->scope == Scope::kFleet) {
      response->set_sessions(response->sessions() + 1);
    }
  }
  if (!request.include_weights()) return absl::OkStatus();
  const std::vector<float>& base = policy.weights.head.weight.values;
  response->mutable_base()->Add(base.begin(), base.end());
  response->mutable_delta()->Add(snapshot->delta.begin(), snapshot->delta.end());
  return absl::OkStatus();
}

absl::Status HeadHandler::PromoteHead(const v1::PromoteHeadRequest& request,
                                      v1::PromoteHeadResponse* response) const {
  absl::MutexLock lock(&promote_mutex_);
  const auto served = registry_->catalog()->Find(request.policy(), request.version());
  if (!served.ok()) return served.status();
  const auto snapshot = (*served)->fleet->Read();
  if (snapshot->drift == 0.0) {
    return absl::FailedPreconditionError(
        absl::StrCat("version: expected one whose shared head has learned, received ",
                     (*served)->version, ", whose shared head equals that of its file"));
  }
  const auto next = NextVersion(registry_->directory(), (*served)->name);
  if (!next.ok()) return next.status();
  const PolicyVersion version = {.policy = (*served)->name, .version = *next};
  const std::string path = PolicyFilePath(registry_->directory(), version);
  if (auto status = WriteNewVersion(Promoted(**served, *snapshot), path); !status.ok()) {
    return status;
  }
  auto loaded = ChangeTraffic(*registry_, version.policy, response->mutable_traffic(), [&] {
    return registry_->LoadVersion(version, request.make_default()).status();
  });
  if (!loaded.ok()) return loaded;
  response->set_version(version.version);
  response->set_path(path);
  return absl::OkStatus();
}

absl::Status HeadHandler::RollbackHead(const v1::RollbackHeadRequest& request,
                                       v1::RollbackHeadResponse* response) const {
  const auto served = registry_->catalog()->Find(request.policy(), request.version());
  if (!served.ok()) return served.status();
  response->set_drift((*served)->fleet->Rollback()->drift);
  return absl::OkStatus();
}

absl::Status HeadHandler::PauseLearning(const v1::PauseLearningRequest& request,
                                        v1::PauseLearningResponse* /*response*/) const {
  return registry_->SetLearningPaused(request.policy(), true);
}

absl::Status HeadHandler::ResumeLearning(const v1::ResumeLearningRequest& request,
                                         v1::ResumeLearningResponse* /*response*/) const {
  return registry_->SetLearningPaused(request.policy(), false);
}

}  // namespace spikeserve
