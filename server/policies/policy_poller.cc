#include "server/policies/policy_poller.h"

#include <utility>

#include "absl/strings/str_cat.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

std::string Named(const PolicyVersion& version) {
  return absl::StrCat(version.policy, "/", version.version);
}

std::set<std::string> Messages(const std::vector<absl::Status>& refused) {
  std::set<std::string> messages;
  for (const absl::Status& status : refused) messages.emplace(status.message());
  return messages;
}

}  // namespace

PolicyPoller::PolicyPoller(PolicyRegistry* registry, absl::Duration interval,
                           const std::vector<absl::Status>& known)
    : registry_(registry), logged_(Messages(known)), thread_(interval, [this] { Poll(); }) {}

void PolicyPoller::Poll() {
  const auto report = registry_->Reload();
  std::set<std::string> refused;
  if (report.ok()) {
    for (const PolicyVersion& version : report->loaded)
      LogInfo("policy loaded", {{"policy", Named(version)}});
    for (const PolicyVersion& version : report->unloaded)
      LogInfo("policy unloaded", {{"policy", Named(version)}});
    refused = Messages(report->refused);
  } else {
    refused.emplace(report.status().message());
  }
  for (const std::string& message : refused) {
    if (!logged_.contains(message)) LogWarning("policy refused", {{"error", message}});
  }
  logged_ = std::move(refused);
}

}  // namespace spikeserve
