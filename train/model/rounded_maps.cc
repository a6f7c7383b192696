#include "train/model/rounded_maps.h"

#include <ATen/ops/linear.h>

#include "core/model/integer_weights.h"

namespace spikeserve {
namespace {

// Returns whether float32 holds every sum of T F products of a count and a weight.
bool FitFloat(int64_t ticks, int64_t hidden) {
  return kLargestInt8Weight * ticks * hidden <= int64_t{1} << 24;
}

}  // namespace

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

torch::Tensor RoundedMaps::MapCounts(const Parameters& parameters, const std::string& name,
                                     const torch::Tensor& hidden) const {
  const int64_t ticks = hidden.size(0);
  const torch::Tensor weight = Through(parameters, name + ".weight", scale(name).unsqueeze(-1));
  const torch::Tensor counts = hidden.sum(0);
  // The order of a sum of float64 does not matter either, and one conversion rounds it.
  const torch::Tensor sums =
      FitFloat(ticks, hidden.size(-1))
          ? at::linear(counts, weight)
          : at::linear(counts.to(torch::kDouble), weight.to(torch::kDouble)).to(torch::kFloat);
  const torch::Tensor factor = scale(name) / static_cast<double>(ticks);
  return sums * factor + parameters[name + ".bias"];
}

}  // namespace spikeserve
