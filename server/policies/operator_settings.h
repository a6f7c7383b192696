// Keeps the settings of operators: those in memory, their file, and those that servers share.
//
// A setting is written to what there is of these before it takes effect, so that it survives a
// restart.
//
//   absl::MutexLock change(&settings.mutex);
//   Settings changed = settings.get();
//   ...
//   RETURN_IF_ERROR(settings.Commit(std::move(changed)));  // ABORTED: another server was faster
//
// Thread-safe as far as no method requires the mutex.
#pragma once

#include <atomic>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/thread_annotations.h"
#include "absl/functional/function_ref.h"
#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/synchronization/mutex.h"
#include "server/policies/policy_catalog.h"
#include "server/policies/policy_settings.h"
#include "server/policies/session_holds.h"
#include "server/policies/shared_settings.h"

namespace spikeserve {

// How often a change is tried while other servers change the settings, too.
inline constexpr int kMostAttempts = 20;

class OperatorSettings {
 public:
  // `path`: of the file; empty: there is none. `shared`: null: the settings are those of this
  // server.
  OperatorSettings(std::string path, DefaultRule default_rule, SharedSettings* shared)
      : path_(std::move(path)),
        default_rule_(default_rule),
        shared_(shared),
        joined_(shared == nullptr) {}

  bool is_shared() const { return shared_ != nullptr; }
  // Returns true if settings outlive this server.
  bool is_kept() const { return is_shared() || !path_.empty(); }
  // Returns true once the shared settings were taken over.
  bool has_joined() const { return joined_.load(std::memory_order_acquire); }
  void SetJoined() { joined_.store(true, std::memory_order_release); }
  // The holds of sessions, which outlive this call.
  const SessionHolds& holds() const { return holds_; }

  mutable absl::Mutex mutex;  // held during a whole change

  // All settings, including those that wait for a version; a catalog has those that are in force.
  const Settings& get() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex) { return settings_; }

  // Reads the file, and writes it, because one that cannot be written would refuse the first change
  // of an operator. Errors name the flag.
  absl::Status ReadFile() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);

  // Takes over the settings that other servers have changed, and returns the former ones; nullopt
  // if they are the same. If the store has none, or has lost changes that it had acknowledged,
  // calls `before_write` and writes those of this server. UNAVAILABLE if the shared settings cannot
  // be reached.
  absl::StatusOr<std::optional<Settings>> Follow(absl::FunctionRef<absl::Status()> before_write)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);

  // Writes the settings to the shared ones, of which the file is a copy, or otherwise to the file.
  // Returns ABORTED if another server has changed them since they were read.
  absl::Status Save(const Settings& settings) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);
  void Replace(Settings settings) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);
  // As Save(), and as Replace() if that succeeds.
  absl::Status Commit(Settings settings) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);

  // Puts into force the settings whose versions are in `catalog`. A default that waits for its
  // version, or was never set, stays the version that it was; if there was none, it is the highest.
  // Returns one line for each setting that waits for its version.
  std::vector<std::string> ApplyTo(PolicyCatalog* catalog) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);

  // Adds the defaults that are in force and were never set, so that neither a later load nor a
  // restart moves them. Saves the settings if that changes them.
  absl::Status KeepDefaults(const PolicyCatalog& catalog) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);

 private:
  absl::Status SaveFile(const Settings& settings) const;
  // Writes the file of settings that are shared. Without it they are in force all the same.
  void SaveCopy(const Settings& settings) const;
  // Writes the settings to the shared ones, in the place of those of revision `replaced`.
  absl::Status WriteShared(const Settings& settings, int64_t replaced)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);
  // Writes the settings of this server where the store has those of revision `found`, which is
  // older, or 0. Returns what the store has then.
  absl::StatusOr<SharedSettings::Document> WriteOwn(int64_t found)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex);

  const std::string path_;
  const DefaultRule default_rule_;
  SharedSettings* const shared_;
  std::atomic<bool> joined_;
  SessionHolds holds_;  // those of settings_
  Settings settings_ ABSL_GUARDED_BY(mutex);
  // The shared settings that were read or written last. Redis may give a revision to other settings
  // if it has lost those that had it.
  SharedSettings::Document known_ ABSL_GUARDED_BY(mutex);
};

}  // namespace spikeserve
