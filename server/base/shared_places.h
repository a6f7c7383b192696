// Divides a number of places, or bytes, between groups, such as tenants: a group takes more as long
// as it then holds no more than were free. One group gets half of all, two a third each, and there
// is room for another.
//
//   SharedPlaces places(256);
//   const auto place = places.Take(tenant->name());
//   if (place == nullptr) return absl::UnavailableError("...");
//
// Thread-safe. Places may outlive this object.
#pragma once

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
  // Holds what was taken until it is destroyed.
  class Place;

  explicit SharedPlaces(int64_t most) : counts_(std::make_shared<Counts>()) {
    absl::MutexLock lock(&counts_->mutex);
    counts_->free = most;
  }

  // Takes `number` places. Returns null if `group` would hold more than are free.
  std::shared_ptr<Place> Take(const std::string& group, int64_t number = 1);

  // Gives back `number` places that were kept.
  void Give(const std::string& group, int64_t number) { counts_->Give(group, number); }

  // Sets how many are free, and what the groups hold in proportion, to all that they hold together.
  // For places that are kept, such as bytes on a disk, once others have changed them.
  void Reset(int64_t free, int64_t held);

 private:
  struct Counts {
    absl::Mutex mutex;
    int64_t free ABSL_GUARDED_BY(mutex) = 0;
    absl::flat_hash_map<std::string, int64_t> taken ABSL_GUARDED_BY(mutex);  // by group

    void Give(const std::string& group, int64_t number) ABSL_LOCKS_EXCLUDED(mutex) {
      absl::MutexLock lock(&mutex);
      free += number;
      if ((taken[group] -= number) <= 0) taken.erase(group);
    }
  };

  const std::shared_ptr<Counts> counts_;
};

class SharedPlaces::Place {
 public:
  Place(std::shared_ptr<Counts> counts, std::string group, int64_t number)
      : counts_(std::move(counts)), group_(std::move(group)), number_(number) {}
  ~Place() {
    if (number_ > 0) counts_->Give(group_, number_);
  }
  Place(const Place&) = delete;
  Place& operator=(const Place&) = delete;

  // Does not give back what it holds. Returns how many places that are.
  int64_t Keep() { return std::exchange(number_, 0); }

 private:
  const std::shared_ptr<Counts> counts_;
  const std::string group_;
  int64_t number_;
};

inline std::shared_ptr<SharedPlaces::Place> SharedPlaces::Take(const std::string& group,
                                                               int64_t number) {
  {
    absl::MutexLock lock(&counts_->mutex);
    const auto taken = counts_->taken.find(group);
    const int64_t held = taken == counts_->taken.end() ? 0 : taken->second;
    if (held + number > counts_->free) return nullptr;
    counts_->free -= number;
    counts_->taken[group] += number;
  }
  return std::make_shared<Place>(counts_, group, number);
}

inline void SharedPlaces::Reset(int64_t free, int64_t held) {
  absl::MutexLock lock(&counts_->mutex);
  counts_->free = free;
  int64_t all = 0;
  for (const auto& [group, number] : counts_->taken) all += number;
  if (all <= held) return;
  const double share = static_cast<double>(held) / static_cast<double>(all);
  for (auto& [group, number] : counts_->taken) {
    number = static_cast<int64_t>(static_cast<double>(number) * share);
  }
}

}  // namespace spikeserve
