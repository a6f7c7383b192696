// What training computes from recorded episodes.
//
// Free functions; safe to call from many threads.
#ifndef TRAIN_DATA_DATASET_H_
#define TRAIN_DATA_DATASET_H_

#include <vector>

#include "core/dataset/dataset.h"

namespace spikeserve {

// [steps]: G_t = r_t + r_{t+1} + ... to the end of the episode; or, where a return was asked for,
// what is left of that.
std::vector<float> ReturnsToGo(const Episode& episode);

// Mean and deviation of every observation entry over all steps, both [obs].
struct Moments {
  std::vector<float> mean;
  std::vector<float> std;  // > 0
};
Moments ObservationMoments(const Dataset& dataset);

}  // namespace spikeserve

#endif  // TRAIN_DATA_DATASET_H_
