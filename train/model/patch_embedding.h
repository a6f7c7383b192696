// A linear patch embedding of small images, as the state embedding of a policy.
//
// An image [height, width, channels] is divided into squares of `size` pixels. One linear map that
// all patches share gives `features` numbers for each, and a second one maps the features of all
// patches to the state token:
//
//   x_state = M concat_i(E patch_i) + b
//
// The product of the two maps is a matrix over all pixels. The policy file holds this product as
// `embed.state.weight`, so engines and their operation counts know nothing of patches.
//
// Symbols: d hidden size, obs = height width channels, n = obs / (size^2 channels) patches,
// k features. Pure functions; safe to call from many threads.
#pragma once

#include <torch/types.h>

#include <cstdint>

#include "absl/status/status.h"

namespace spikeserve {

struct PatchShape {
  int height = 0;
  int width = 0;
  int channels = 0;
  int size = 0;  // pixels; 0: no patches
  int features = 8;

  bool used() const { return size > 0; }
  int pixels() const { return height * width * channels; }          // obs
  int patches() const { return (height / size) * (width / size); }  // n
  int inputs() const { return size * size * channels; }             // of one patch

  // Returns INVALID_ARGUMENT, with the names of the flags --image_shape and --patch_size, unless
  // the image has `observation_size` numbers and patches fill it.
  absl::Status Validate(int observation_size) const;
};

// The two maps.
struct PatchMaps {
  torch::Tensor embedding;  // E [k, size^2 channels]
  torch::Tensor mix;        // M [d, n k]
};

// Returns random maps, uniform within 1 / sqrt(inputs).
PatchMaps RandomPatchMaps(const PatchShape& shape, int hidden_size, uint64_t seed);

// Returns the product of the maps, [d, obs]. The gradient flows back to them.
torch::Tensor FoldPatches(const PatchShape& shape, const PatchMaps& maps);

}  // namespace spikeserve
