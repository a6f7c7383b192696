#include "server/base/shared_folder.h"

#include <filesystem>
#include <system_error>

namespace spikeserve {
namespace {

constexpr absl::Duration kMeasureInterval = absl::Minutes(1);

}  // namespace

void SharedFolder::Keep(SharedPlaces::Place& place) {
  {
    absl::MutexLock lock(&mutex_);
    report_(bytes_ += place.Keep(), max_bytes_);
  }
  Measure();
}

void SharedFolder::Remove(const std::string& tenant, int64_t bytes) {
  places_.Give(tenant, bytes);
  absl::MutexLock lock(&mutex_);
  report_(bytes_ -= bytes, max_bytes_);
}

void SharedFolder::Measure() {
  absl::MutexLock lock(&mutex_);
  const absl::Duration now = clock_.Now();
  if (now - measured_ < kMeasureInterval) return;
  measured_ = now;
  bytes_ = 0;
  std::error_code error;
  for (std::filesystem::recursive_directory_iterator it(directory_, error), end;
       !error && it != end; it.increment(error)) {
    std::error_code none;  // a file that has just been removed
    const auto size = it->is_regular_file(none) ? it->file_size(none) : 0;
    if (!none) bytes_ += static_cast<int64_t>(size);
  }
  places_.Reset(max_bytes_ - bytes_, bytes_);
  report_(bytes_, max_bytes_);
}

}  // namespace spikeserve
