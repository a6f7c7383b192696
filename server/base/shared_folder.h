// The bytes of a folder, which tenants divide (SharedPlaces). What is there is measured when the
// server starts, and again when a file is written or asked for, at most once a minute, because
// others may add files and remove them.
//
//   const auto place = folder.Take(tenant, bytes);
//   if (place == nullptr) return absl::ResourceExhaustedError("...");
//   RETURN_IF_ERROR(WriteFile(...));
//   folder.Keep(*place);
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/clock.h"
#include "server/base/shared_places.h"

namespace spikeserve {

class SharedFolder {
 public:
  // Exports how many bytes are in the folder, of how many that may be there.
  using Report = std::function<void(int64_t bytes, int64_t limit)>;

  SharedFolder(std::string directory, int64_t max_bytes, Report report)
      : directory_(std::move(directory)),
        max_bytes_(max_bytes),
        report_(std::move(report)),
        places_(max_bytes) {
    Measure();
  }

  const std::string& directory() const { return directory_; }

  // Reserves room for a file of `tenant`. Returns null if the tenant would have more bytes than are
  // free.
  std::shared_ptr<SharedPlaces::Place> Take(const std::string& tenant, int64_t bytes) {
    return places_.Take(tenant, bytes);
  }

  // The file was written. Measures the folder if a minute has passed.
  void Keep(SharedPlaces::Place& place) ABSL_LOCKS_EXCLUDED(mutex_);

  // A file of `bytes` was removed, in the place of which `tenant` may write others.
  void Remove(const std::string& tenant, int64_t bytes) ABSL_LOCKS_EXCLUDED(mutex_);

  // Measures the folder if a minute has passed.
  void Measure() ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  const std::string directory_;
  const int64_t max_bytes_;
  const Report report_;
  SharedPlaces places_;
  const SteadyClock clock_;
  absl::Mutex mutex_;
  int64_t bytes_ ABSL_GUARDED_BY(mutex_) = 0;  // by what was measured and written since
  absl::Duration measured_ ABSL_GUARDED_BY(mutex_) = -absl::InfiniteDuration();
};

}  // namespace spikeserve
