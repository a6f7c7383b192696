#include "server/policies/operator_settings.h"

#include <set>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/base/log.h"

namespace spikeserve {

absl::Status OperatorSettings::ReadFile() {
  if (path_.empty()) return absl::OkStatus();
  auto settings = ReadSettings(path_);
  if (!settings.ok()) return Annotate(settings.status(), "--policy_settings");
  return Annotate(Commit(*std::move(settings)),
                  "--policy_settings: expected a file in a directory that the server can write");
}

absl::StatusOr<std::optional<Settings>> OperatorSettings::Follow(
    absl::FunctionRef<absl::Status()> before_write) {
  if (!is_shared()) return std::nullopt;
  ASSIGN_OR_RETURN(auto document, shared_->Read());
  for (int i = 0; document.revision == 0 || document.revision < known_.revision; ++i) {
    if (i == kMostAttempts) {
      return absl::UnavailableError(absl::StrCat("settings: the store has ",
                                                 document.revision == 0 ? "no" : "older",
                                                 " settings and takes none"));
    }
    RETURN_IF_ERROR(before_write());
    ASSIGN_OR_RETURN(document, WriteOwn(document.revision));
  }
  if (document == known_) return std::nullopt;
  auto settings = ParseSettings(document.json);
  if (!settings.ok()) return Annotate(settings.status(), "shared settings");
  Settings before = settings_;
  known_ = std::move(document);
  Replace(*std::move(settings));
  SaveCopy(settings_);
  return before;
}

absl::Status OperatorSettings::WriteShared(const Settings& settings, int64_t replaced) {
  SharedSettings::Document written = {.revision = known_.revision + 1, .json = ToJson(settings)};
  RETURN_IF_ERROR(shared_->Write(written, replaced));
  known_ = std::move(written);
  return absl::OkStatus();
}

absl::StatusOr<SharedSettings::Document> OperatorSettings::WriteOwn(int64_t found) {
  const bool had_shared = known_.revision > 0;
  const auto status = WriteShared(settings_, found);
  if (absl::IsAborted(status)) return shared_->Read();  // another server was faster
  RETURN_IF_ERROR(status);
  // Operators must hear of it: what they had set may be lost.
  LogWarning(absl::StrCat("the store has ", found == 0 ? "no" : "older",
                          " settings; it gets those of this server"),
             {{"settings", had_shared      ? "that the servers had shared"
                           : path_.empty() ? "defaults"
                                           : path_}});
  return known_;
}

absl::Status OperatorSettings::Save(const Settings& settings) {
  if (!is_shared() || !has_joined()) return SaveFile(settings);
  RETURN_IF_ERROR(WriteShared(settings, known_.revision));
  SaveCopy(settings);
  return absl::OkStatus();
}

void OperatorSettings::SaveCopy(const Settings& settings) const {
  if (auto status = SaveFile(settings); !status.ok()) {
    LogError("shared settings not saved", {{"error", status.message()}});
  }
}

absl::Status OperatorSettings::SaveFile(const Settings& settings) const {
  return path_.empty() ? absl::OkStatus() : WriteSettings(settings, path_);
}

void OperatorSettings::Replace(Settings settings) {
  if (settings.holds != settings_.holds) holds_.Set(settings.holds);
  settings_ = std::move(settings);
}

absl::Status OperatorSettings::Commit(Settings settings) {
  RETURN_IF_ERROR(Save(settings));
  Replace(std::move(settings));
  return absl::OkStatus();
}

std::vector<std::string> OperatorSettings::ApplyTo(PolicyCatalog* catalog) const {
  std::vector<std::string> waiting;
  const auto effective_settings = [&](const std::string& name, const std::set<int64_t>& versions) {
    mutex.AssertHeld();
    const auto set = settings_.policies.find(name);
    if (set == settings_.policies.end()) return PolicySettings();
    std::vector<std::string> lines;
    PolicySettings effective = EffectiveSettings(set->second, versions, &lines);
    for (const std::string& line : lines) {
      waiting.push_back(absl::StrCat(path_, ": policies.", name, ".", line));
    }
    return effective;
  };
  for (const auto& [name, settings] : settings_.policies) {
    if (!catalog->policies().contains(name)) effective_settings(name, {});
  }
  for (auto& [name, policy] : catalog->policies()) {
    std::set<int64_t> versions;
    for (const auto& [version, served] : policy.versions) versions.insert(version);
    PolicySettings effective = effective_settings(name, versions);
    const bool follows =
        effective.default_follows_highest || default_rule_ == DefaultRule::kHighest;
    if (effective.default_version == 0 && !follows) {
      const int64_t before = policy.settings.default_version;
      effective.default_version = versions.contains(before) ? before : *versions.rbegin();
    }
    policy.settings = std::move(effective);
  }
  return waiting;
}

absl::Status OperatorSettings::KeepDefaults(const PolicyCatalog& catalog) {
  Settings settings = settings_;
  for (const auto& [name, policy] : catalog.policies()) {
    PolicySettings& kept = settings.policies[name];
    if (kept.default_version == 0 && !kept.default_follows_highest) {
      kept.default_version = policy.settings.default_version;  // 0 with DefaultRule::kHighest
    }
  }
  if (settings.policies == settings_.policies) return absl::OkStatus();
  return Commit(std::move(settings));
}

}  // namespace spikeserve
