#include "train/model/rounded_maps.h"

#include <ATen/ops/linear.h>

namespace spikeserve {
RoundedMaps::RoundedMaps(const Policy& rounded) : tensors_(CopyTensors(rounded)) {}

torch::Tensor RoundedMaps::Through(const Parameters& parameters, const std::string& name,
                                   const torch::Tensor& scale) const {
  const torch::Tensor& parameter = parameters[name];
  return tensors_.at(name) + (parameter - parameter.detach()) / scale;
}

torch::Tensor RoundedMaps::Current(const Parameters& parameters, const std::string& name,
                                   const torch::Tensor& spikes) const {
  return at::linear(spikes, Through(parameters, name + ".weight", scale(name).unsqueeze(-1)),
                    Through(parameters, name + ".bias", scale(name)));
}

const torch::Tensor& RoundedMaps::threshold(const std::string& name) const {
  return tensors_.at(name + ".threshold");
}

const torch::Tensor& RoundedMaps::bias(const std::string& name) const {
  return tensors_.at(name + ".bias");
}

const torch::Tensor& RoundedMaps::scale(const std::string& name) const {
  return tensors_.at(name + ".scale");
}

}  // namespace spikeserve
