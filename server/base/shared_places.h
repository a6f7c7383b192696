// Divides a number of places between groups, such as tenants: a group takes one more as long as it
// holds fewer than are free. One group gets half of all, two a third each, and there is room for
// another.
//
//   SharedPlaces places(256);
//   const auto place = places.Take(tenant->name());
//   if (place == nullptr) return absl::UnavailableError("...");
//
// Thread-safe. Places may outlive this object.
#ifndef SERVER_BASE_SHARED_PLACES_H_
#define SERVER_BASE_SHARED_PLACES_H_

#include <cstdint>
#include <memory>
#include <string>
#include <utility>

#include "absl/base/thread_annotations.h"
#include "absl/container/flat_hash_map.h"
#include "absl/synchronization/mutex.h"

namespace spikeserve {

class SharedPlaces {
 public:
  // Holds one place until it is destroyed.
  class Place;

  explicit SharedPlaces(int64_t most) : counts_(std::make_shared<Counts>()) {
    absl::MutexLock lock(&counts_->mutex);
    counts_->free = most;
  }

  // Returns null if `group` holds as many places as are free.
  std::shared_ptr<Place> Take(const std::string& group);

 private:
  struct Counts {
    absl::Mutex mutex;
    int64_t free ABSL_GUARDED_BY(mutex) = 0;
    absl::flat_hash_map<std::string, int64_t> taken ABSL_GUARDED_BY(mutex);  // by group
  };

  const std::shared_ptr<Counts> counts_;
};

class SharedPlaces::Place {
 public:
  Place(std::shared_ptr<Counts> counts, std::string group)
      : counts_(std::move(counts)), group_(std::move(group)) {}
  ~Place() {
    absl::MutexLock lock(&counts_->mutex);
    ++counts_->free;
    if (--counts_->taken[group_] == 0) counts_->taken.erase(group_);
  }
  Place(const Place&) = delete;
  Place& operator=(const Place&) = delete;

 private:
  const std::shared_ptr<Counts> counts_;
  const std::string group_;
};

inline std::shared_ptr<SharedPlaces::Place> SharedPlaces::Take(const std::string& group) {
  {
    absl::MutexLock lock(&counts_->mutex);
    const auto taken = counts_->taken.find(group);
    if ((taken == counts_->taken.end() ? 0 : taken->second) >= counts_->free) return nullptr;
    --counts_->free;
    ++counts_->taken[group];
  }
  return std::make_shared<Place>(counts_, group);
}

}  // namespace spikeserve

#endif  // SERVER_BASE_SHARED_PLACES_H_
