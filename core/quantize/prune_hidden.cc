#include "core/quantize/prune_hidden.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

// Returns the indices that are needed and, up to `size` of them, the first ones of the rest, in
// order.
std::vector<int> Choose(const std::vector<bool>& is_needed, int size) {
  auto spare = size - std::count(is_needed.begin(), is_needed.end(), true);
  std::vector<int> kept;
  for (size_t j = 0; j < is_needed.size(); ++j) {
    if (is_needed[j] || spare-- > 0) kept.push_back(static_cast<int>(j));
  }
  return kept;
}

// Keeps the given entries of a vector, or rows of a matrix.
template <class Number>
void KeepRows(const std::vector<int>& kept, BasicTensor<Number>* tensor) {
  const size_t width = tensor->shape.size() == 1 ? 1 : static_cast<size_t>(tensor->shape[1]);
  std::vector<Number> values;
  for (const int row : kept) {
    const auto first = tensor->values.begin() + static_cast<ptrdiff_t>(row * width);
    values.insert(values.end(), first, first + static_cast<ptrdiff_t>(width));
  }
  tensor->shape[0] = static_cast<int>(kept.size());
  tensor->values = std::move(values);
}

void KeepColumns(const std::vector<int>& kept, Int8Tensor* matrix) {
  std::vector<int8_t> values;
  for (int row = 0; row < matrix->shape[0]; ++row) {
    for (const int column : kept) values.push_back(matrix->at(row, column));
  }
  matrix->shape[1] = static_cast<int>(kept.size());
  matrix->values = std::move(values);
}

}  // namespace

Policy PruneHidden(const Policy& policy, const std::vector<std::vector<bool>>& is_needed) {
  SPIKESERVE_DCHECK(policy.config.arithmetic == Arithmetic::kInteger && !policy.config.is_dense());
  SPIKESERVE_DCHECK_EQ(is_needed.size(), policy.weights.layers.size());
  ptrdiff_t size = 1;
  for (const std::vector<bool>& layer : is_needed) {
    SPIKESERVE_DCHECK_EQ(layer.size(), static_cast<size_t>(policy.config.ffn_size));
    size = std::max(size, std::count(layer.begin(), layer.end(), true));
  }
  Policy pruned = policy;
  pruned.config.ffn_size = static_cast<int>(size);
  for (size_t i = 0; i < is_needed.size(); ++i) {
    const std::vector<int> kept = Choose(is_needed[i], pruned.config.ffn_size);
    IntegerPopulation& hidden = pruned.weights.layers[i].integer.ffn_hidden;
    KeepRows(kept, &hidden.weight);
    KeepRows(kept, &hidden.scale);
    KeepRows(kept, &hidden.bias);
    KeepRows(kept, &hidden.threshold);
    KeepColumns(kept, &pruned.weights.layers[i].fixed_point.ffn_output.weight);
  }
  return pruned;
}

}  // namespace spikeserve
