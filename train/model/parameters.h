// The weights of a policy as torch tensors, by their names in the policy file.
#ifndef TRAIN_MODEL_PARAMETERS_H_
#define TRAIN_MODEL_PARAMETERS_H_

#include <torch/types.h>

#include <map>
#include <string>

#include "core/model/policy.h"

namespace spikeserve {

// Returns copies of all tensors of a policy as float32, by name. Integers keep their values.
std::map<std::string, torch::Tensor> CopyTensors(const Policy& policy);

// Not thread-safe while the tensors are modified.
class Parameters {
 public:
  // Copies the policy's weights. All tensors require a gradient except `observation.*`, which are
  // computed from the data and not trained. REQUIRES: the policy is float32.
  explicit Parameters(const Policy& policy);

  // REQUIRES: a tensor of that name exists.
  const torch::Tensor& operator[](const std::string& name) const { return tensors_.at(name); }

  // Returns W x + b with the tensors `name`.weight and `name`.bias.
  torch::Tensor Linear(const torch::Tensor& x, const std::string& name) const;

  // Returns LayerNorm(x) over the last dimension with the tensors `name`.weight and `name`.bias and
  // the epsilon of core (kLayerNormEpsilon).
  torch::Tensor Norm(const torch::Tensor& x, const std::string& name) const;

  // Returns all tensors by name, in alphabetical order.
  const std::map<std::string, torch::Tensor>& tensors() const { return tensors_; }

  // Writes the current values into `policy`. REQUIRES: `policy` has the shapes of the policy that
  // this object was created from.
  void Store(Policy* policy) const;

 private:
  std::map<std::string, torch::Tensor> tensors_;
};

}  // namespace spikeserve

#endif  // TRAIN_MODEL_PARAMETERS_H_
