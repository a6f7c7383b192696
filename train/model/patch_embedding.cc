#include "train/model/patch_embedding.h"

#include <cmath>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

constexpr uint64_t kPatches = 15;  // first part of the keys of the random weights

torch::Tensor RandomMatrix(int64_t rows, int64_t columns, uint64_t seed, uint64_t which) {
  torch::Tensor matrix = torch::empty({rows, columns});
  const float bound = 1.0f / std::sqrt(static_cast<float>(columns));
  float* const values = matrix.data_ptr<float>();
  for (int64_t i = 0; i < rows * columns; ++i) {
    const uint64_t bits = RandomBits({kPatches, seed, which, static_cast<uint64_t>(i)});
    values[i] = bound * (2.0f * UniformFloat(bits) - 1.0f);
  }
  return matrix;
}

}  // namespace

absl::Status PatchShape::Validate(int observation_size) const {
  if (height < 1 || width < 1 || channels < 1 || height > observation_size / width / channels ||
      pixels() != observation_size) {
    return InvalidArgument("--image_shape",
                           absl::StrCat("HEIGHT,WIDTH,CHANNELS of the ", observation_size,
                                        " numbers of an observation"),
                           absl::StrCat(height, ",", width, ",", channels));
  }
  if (size < 1 || height % size != 0 || width % size != 0) {
    return InvalidArgument(
        "--patch_size", absl::StrCat("a divisor of height ", height, " and width ", width), size);
  }
  if (features < 1) {
    return InvalidArgument("--patch_features", "at least 1", features);
  }
  return absl::OkStatus();
}

PatchMaps RandomPatchMaps(const PatchShape& shape, int hidden_size, uint64_t seed) {
  return {.embedding = RandomMatrix(shape.features, shape.inputs(), seed, 0),
          .mix = RandomMatrix(hidden_size, shape.patches() * shape.features, seed, 1)};
}

torch::Tensor FoldPatches(const PatchShape& shape, const PatchMaps& maps) {
  const int64_t hidden = maps.mix.size(0);
  const int64_t rows = shape.height / shape.size, columns = shape.width / shape.size;
  const torch::Tensor by_patch =
      torch::matmul(maps.mix.view({hidden, rows * columns, shape.features}), maps.embedding);
  return by_patch.view({hidden, rows, columns, shape.size, shape.size, shape.channels})
      .permute({0, 1, 3, 2, 4, 5})
      .reshape({hidden, shape.pixels()});
}

}  // namespace spikeserve
