// A policy's tensors under their names in the policy file, as torch tensors.
#ifndef TRAIN_MODEL_PARAMETERS_H_
#define TRAIN_MODEL_PARAMETERS_H_

#include <torch/types.h>

#include <map>
#include <string>

#include "core/model/policy.h"

namespace spikeserve {

class Parameters {
 public:
  // Copies of the policy's weights. All but `observation.*`, which are the data's, require a
  // gradient.
  explicit Parameters(const Policy& policy);

  // REQUIRES: a tensor of that name exists.
  const torch::Tensor& operator[](const std::string& name) const { return tensors_.at(name); }

  // W x + b with the tensors `name`.weight and `name`.bias.
  torch::Tensor Linear(const torch::Tensor& x, const std::string& name) const;

  // LayerNorm over the last dimension with the tensors `name`.weight and `name`.bias, epsilon as in
  // core.
  torch::Tensor Norm(const torch::Tensor& x, const std::string& name) const;

  // By name, in alphabetical order.
  const std::map<std::string, torch::Tensor>& tensors() const { return tensors_; }

  // Writes the current values into `policy`, which must have the shape of the one this was made
  // from.
  void Store(Policy* policy) const;

 private:
  std::map<std::string, torch::Tensor> tensors_;
};

}  // namespace spikeserve

#endif  // TRAIN_MODEL_PARAMETERS_H_
