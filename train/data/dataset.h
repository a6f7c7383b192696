// Quantities that training computes from recorded episodes.
//
// Pure functions; safe to call from many threads.
#ifndef TRAIN_DATA_DATASET_H_
#define TRAIN_DATA_DATASET_H_

#include <vector>

#include "core/dataset/dataset.h"

namespace spikeserve {

// Computes the return-to-go of every step, [steps]: G_t = r_t + r_{t+1} + ... up to the end of the
// episode. If the episode has a target_return R, G_t = R - (r_0 + ... + r_{t-1}) instead.
std::vector<float> ReturnsToGo(const Episode& episode);

// Mean and standard deviation of each observation entry over all steps, both [obs].
struct Moments {
  std::vector<float> mean;
  std::vector<float> std;  // > 0
};
Moments ObservationMoments(const Dataset& dataset);

}  // namespace spikeserve

#endif  // TRAIN_DATA_DATASET_H_
