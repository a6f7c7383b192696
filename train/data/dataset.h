// Quantities that training computes from recorded episodes.
//
// Functions are pure and safe to call from many threads; DataStatistics is a plain value.
#pragma once

#include <cstdint>
#include <vector>

#include "Eigen/Core"
#include "core/dataset/dataset.h"

namespace spikeserve {

// Computes the return-to-go of every step, [steps]: G_t = r_t + r_{t+1} + ... up to the end of the
// episode. If the episode has a target_return R, G_t = R - (r_0 + ... + r_{t-1}) instead.
std::vector<float> ReturnsToGo(const Episode& episode);

// Returns the bytes of memory that an episode takes while a ClipSampler draws from it.
int64_t MemoryOf(const Episode& episode);

// Mean and standard deviation of each observation entry over all steps, both [obs].
struct Moments {
  std::vector<float> mean;
  std::vector<float> std;  // > 0
};

// What a new policy needs to know about the data. Adds up one episode at a time, so that not all
// episodes have to be in memory.
class DataStatistics {
 public:
  explicit DataStatistics(int observation_size);

  void Add(const Episode& episode);

  // The functions below describe the episodes added so far. REQUIRES: at least one episode.

  // Returns the moments of each entry of the observation. The deviation of an entry that is
  // constant in the data is 1.
  Moments observations() const { return PooledMoments(static_cast<int>(sum_.size())); }
  // Returns for every entry the moments of all entries of its group: those with the same index
  // modulo `groups`. The pixels of an image [height, width, channels] are in `channels` groups.
  // REQUIRES: `groups` divides the size of an observation.
  Moments PooledMoments(int groups) const;
  // Returns the root mean square of each entry's change from one step to the next, [obs]. That of
  // an entry that never changes is 1.
  std::vector<float> change_std() const;
  // Returns the moments of each element of the actions to imitate, in environment units, [act];
  // both empty for a Discrete space. The deviation of an element that is constant in the data is 1.
  Moments labels() const;
  // Mean and standard deviation of the returns-to-go of all steps: mu and sigma of eq. 4.2.
  float return_mean() const;
  float return_std() const;
  float best_return() const { return best_return_; }

 private:
  Eigen::ArrayXd sum_, squares_;              // of the observations, [obs]
  Eigen::ArrayXd squared_changes_;            // [obs]
  Eigen::ArrayXd label_sum_, label_squares_;  // of a Box, [act]
  double steps_ = 0.0;
  double changes_ = 0.0;  // steps that have one before them
  double return_sum_ = 0.0, return_squares_ = 0.0;
  float best_return_ = 0.0f;
};

}  // namespace spikeserve
