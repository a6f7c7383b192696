// What simple models learn from the same data: a linear map, and a multilayer perceptron with two
// hidden layers of equal width (tanh), from the last 1, 2 or 4 observations to the action.
//
// A policy that is worse than one of them has not learned what the data can teach.
//
// Plain values; functions are safe to call from many threads. Symbols: obs length of an
// observation, act outputs of the action head.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "Eigen/Core"
#include "core/action/action_space.h"
#include "core/base/enum_names.h"
#include "nlohmann/json.hpp"
#include "train/baselines/step_table.h"

namespace spikeserve {

enum class BaselineKind { kLine, kMlp };

constexpr std::array<EnumName<BaselineKind>, 2> EnumNames(BaselineKind) {
  return {{{BaselineKind::kLine, "line"}, {BaselineKind::kMlp, "mlp"}}};
}

struct Baseline {
  // y = W x + b.
  struct Layer {
    RowMajorMatrix<float> weight;  // [out, in]
    Eigen::VectorXf bias;          // [out]
  };

  BaselineKind kind = BaselineKind::kLine;
  int frames = 1;                  // 1, 2 or 4
  bool is_discrete = false;        // the outputs are scores
  Eigen::RowVectorXf mean = {};    // [frames obs], of the inputs
  Eigen::RowVectorXf std = {};     // [frames obs], > 0
  std::vector<Layer> layers = {};  // tanh follows all but the last

  // "line on 2 frames".
  std::string Name() const;

  // Returns the neurons of a hidden layer; 0 for a line.
  int width() const { return layers.size() < 2 ? 0 : static_cast<int>(layers[0].bias.size()); }

  // Returns the outputs for rows of FrameInput, [rows, act]: encoded actions of a Box within
  // [-1, 1], or scores of which the largest is the action.
  RowMajorMatrix<float> Outputs(const Eigen::Ref<const RowMajorMatrix<float>>& inputs) const;

  // Returns kind, frames, mean, std and layers, with which another program can play it.
  nlohmann::ordered_json ToJson() const;
};

// The most numbers of an observation for which baselines are fitted: the time of a fit grows with
// the cube of the number.
inline constexpr int kMostBaselineInputs = 128;

// Fits the linear map by least squares, with a small ridge.
Baseline FitLine(const ActionSpace& space, const StepTable& table, int frames);

struct MlpFit {
  int width = 64;      // neurons of each of the two hidden layers
  uint64_t seed = 0;   // of the first weights and the batches
  bool quick = false;  // 1,500 batches, to tell whether an input helps at all
};

// Fits the perceptron to `training` with Adam: the mean squared error for a Box, the cross-entropy
// for a Discrete space, weighted. The learning rate falls, and the fit ends, when the loss on
// `held_out` stops falling; the result has the weights with the lowest. The same seed gives the
// same result.
Baseline FitMlp(const ActionSpace& space, const StepTable& training, const StepTable& held_out,
                int frames, const MlpFit& fit = {});

}  // namespace spikeserve
