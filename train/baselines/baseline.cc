#include "train/baselines/baseline.h"

#include <ATen/ops/linear.h>
#include <torch/optim/adam.h>
#include <torch/types.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "Eigen/Cholesky"
#include "absl/strings/str_cat.h"
#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

using Matrix = RowMajorMatrix<float>;

constexpr double kRidge = 1e-6;  // of the standardised inputs, relative to the number of rows
constexpr int kBatch = 256;
constexpr int kMostIterations = 12'000, kMostQuickIterations = 1500;
constexpr int64_t kMostPasses = 1000;  // over all rows, of which a short recording has few
// The loss on held-out steps is checked after about an epoch. After so many checks without a new
// lowest, the fit returns to the best weights with a lower rate, until that is below the least.
constexpr int kLeastCheck = 50, kMostCheck = 300;
constexpr int kPatience = 4;
constexpr double kFirstRate = 3e-3, kRateFall = 0.3, kLeastRate = 2e-4;

// Returns an unfitted baseline with the moments of its inputs.
Baseline Unfitted(BaselineKind kind, const ActionSpace& space, const StepTable& table, int frames) {
  const Eigen::Index columns = table.inputs.cols() / kMostFrames * frames;
  const auto inputs = table.inputs.leftCols(columns);
  Baseline baseline = {.kind = kind, .frames = frames, .is_discrete = space.is_discrete()};
  baseline.mean = inputs.colwise().mean();
  const Eigen::RowVectorXf variance =
      (inputs.rowwise() - baseline.mean).array().square().colwise().mean();
  // What rounding leaves of a constant is not divided by.
  const Eigen::RowVectorXf level = 1e-6f * baseline.mean.cwiseAbs().cwiseMax(1.0f);
  const Eigen::RowVectorXf deviation = variance.cwiseSqrt();
  baseline.std = (deviation.array() > level.array()).select(deviation, 1.0f);
  return baseline;
}

Matrix Standardise(const Baseline& baseline, const Eigen::Ref<const Matrix>& inputs) {
  const auto read = inputs.leftCols(baseline.mean.size());
  return (read.rowwise() - baseline.mean).array().rowwise() / baseline.std.array();
}

torch::Tensor ToTensor(const Matrix& matrix) {
  return torch::from_blob(const_cast<float*>(matrix.data()), {matrix.rows(), matrix.cols()})
      .clone();
}

torch::Tensor RandomWeight(int64_t out, int64_t in, uint64_t seed, uint64_t layer) {
  torch::Tensor weight = torch::empty({out, in});
  const float bound = std::sqrt(3.0f / static_cast<float>(in));
  float* const values = weight.data_ptr<float>();
  for (int64_t i = 0; i < out * in; ++i) {
    const uint64_t bits = RandomBits({seed, layer, static_cast<uint64_t>(i)});
    values[i] = bound * (2.0f * UniformFloat(bits) - 1.0f);
  }
  return weight.set_requires_grad(true);
}

// The weights and biases of the perceptron, in turn.
using MlpTensors = std::vector<torch::Tensor>;

MlpTensors RandomMlp(int64_t inputs, int64_t outputs, const MlpFit& fit) {
  MlpTensors tensors;
  int64_t in = inputs;
  for (const int64_t out : {int64_t{fit.width}, int64_t{fit.width}, outputs}) {
    tensors.push_back(RandomWeight(out, in, fit.seed, tensors.size()));
    tensors.push_back(torch::zeros({out}).set_requires_grad(true));
    in = out;
  }
  return tensors;
}

torch::Tensor Forward(const MlpTensors& tensors, torch::Tensor x) {
  for (size_t i = 0; i < tensors.size(); i += 2) {
    if (i > 0) x = torch::tanh(x);
    x = at::linear(x, tensors[i], tensors[i + 1]);
  }
  return x;
}

// A table as tensors, with standardised inputs.
struct Rows {
  torch::Tensor inputs, targets, weights;

  Rows(const Baseline& baseline, const StepTable& table)
      : inputs(ToTensor(Standardise(baseline, table.inputs))),
        targets(ToTensor(table.targets)),
        weights(ToTensor(table.weights).view({-1})) {}
};

torch::Tensor Loss(const ActionSpace& space, const torch::Tensor& outputs,
                   const torch::Tensor& targets, const torch::Tensor& weights) {
  const torch::Tensor losses = space.is_discrete()
                                   ? -(torch::log_softmax(outputs, -1) * targets).sum(-1)
                                   : (outputs - targets).square().mean(-1);
  return (losses * weights).sum() / (weights.sum() + 1e-12);
}

torch::Tensor DrawBatch(uint64_t seed, int iteration, int64_t rows) {
  std::vector<int64_t> batch(kBatch);
  for (int i = 0; i < kBatch; ++i) {
    const uint64_t bits =
        RandomBits({seed, static_cast<uint64_t>(1000 + iteration), static_cast<uint64_t>(i)});
    batch[static_cast<size_t>(i)] = static_cast<int64_t>(bits % static_cast<uint64_t>(rows));
  }
  return torch::tensor(batch);
}

// Keeps the tensors with the lowest loss on held-out steps, and lowers the rate when that stops
// falling.
class Descent {
 public:
  Descent(const ActionSpace& space, const Rows& held_out, MlpTensors* tensors)
      : space_(space),
        held_out_(held_out),
        tensors_(*tensors),
        adam_(*tensors, torch::optim::AdamOptions(kFirstRate)) {}

  void Step(const torch::Tensor& loss) {
    adam_.zero_grad();
    loss.backward();
    adam_.step();
  }

  // Returns whether it is worth going on.
  bool Check() {
    const torch::NoGradGuard no_gradients;
    const double loss =
        Loss(space_, Forward(tensors_, held_out_.inputs), held_out_.targets, held_out_.weights)
            .item<double>();
    if (loss < lowest_) {
      lowest_ = loss;
      kept_.clear();
      for (const torch::Tensor& tensor : tensors_) kept_.push_back(tensor.clone());
      waited_ = 0;
      return true;
    }
    if (++waited_ < kPatience) return true;
    waited_ = 0;
    Restore();
    rate_ *= kRateFall;
    adam_.param_groups()[0].options().set_lr(rate_);
    return rate_ >= kLeastRate;
  }

  void Restore() {
    const torch::NoGradGuard no_gradients;
    for (size_t i = 0; i < kept_.size(); ++i) tensors_[i].copy_(kept_[i]);
  }

 private:
  const ActionSpace& space_;
  const Rows& held_out_;
  MlpTensors& tensors_;
  torch::optim::Adam adam_;
  double lowest_ = std::numeric_limits<double>::infinity();
  double rate_ = kFirstRate;
  int waited_ = 0;
  MlpTensors kept_;
};

void Train(const ActionSpace& space, const Rows& training, const Rows& held_out, const MlpFit& fit,
           MlpTensors* tensors) {
  const int64_t rows = training.inputs.size(0);
  const auto check = static_cast<int>(std::clamp<int64_t>(rows / kBatch, kLeastCheck, kMostCheck));
  const int64_t most = std::min<int64_t>(fit.quick ? kMostQuickIterations : kMostIterations,
                                         kMostPasses * (1 + rows / kBatch));
  Descent descent(space, held_out, tensors);
  for (int iteration = 1; iteration <= most; ++iteration) {
    const torch::Tensor batch = DrawBatch(fit.seed, iteration, rows);
    descent.Step(Loss(space, Forward(*tensors, training.inputs.index_select(0, batch)),
                      training.targets.index_select(0, batch),
                      training.weights.index_select(0, batch)));
    if (iteration % check == 0 && !descent.Check()) break;
  }
  descent.Restore();
}

nlohmann::ordered_json ToJsonRows(const Matrix& matrix) {
  nlohmann::ordered_json rows = nlohmann::ordered_json::array();
  for (const auto row : matrix.rowwise()) {
    rows.push_back(std::vector<float>(row.begin(), row.end()));
  }
  return rows;
}

}  // namespace

std::string Baseline::Name() const {
  return absl::StrCat(std::string(ToString(kind)), " on ", frames,
                      frames == 1 ? " frame" : " frames");
}

Matrix Baseline::Outputs(const Eigen::Ref<const Matrix>& inputs) const {
  Matrix x = Standardise(*this, inputs);
  for (size_t i = 0; i < layers.size(); ++i) {
    if (i > 0) x = x.array().tanh().matrix().eval();
    x = ((x * layers[i].weight.transpose()).rowwise() + layers[i].bias.transpose()).eval();
  }
  return is_discrete ? x : Matrix(x.cwiseMax(-1.0f).cwiseMin(1.0f));
}

nlohmann::ordered_json Baseline::ToJson() const {
  nlohmann::ordered_json json = {{"kind", std::string(ToString(kind))},
                                 {"frames", frames},
                                 {"mean", std::vector<float>(mean.begin(), mean.end())},
                                 {"std", std::vector<float>(std.begin(), std.end())}};
  for (const Layer& layer : layers) {
    json["layers"].push_back({{"weight", ToJsonRows(layer.weight)},
                              {"bias", std::vector<float>(layer.bias.begin(), layer.bias.end())}});
  }
  return json;
}

Baseline FitLine(const ActionSpace& space, const StepTable& table, int frames) {
  Baseline baseline = Unfitted(BaselineKind::kLine, space, table, frames);
  const Matrix x = Standardise(baseline, table.inputs);
  Eigen::MatrixXd inputs(x.rows(), x.cols() + 1);
  inputs << x.cast<double>(), Eigen::VectorXd::Ones(x.rows());
  const Eigen::MatrixXd weighted = table.weights.cast<double>().asDiagonal() * inputs;
  Eigen::MatrixXd normal = weighted.transpose() * inputs;
  normal.diagonal().array() += kRidge * static_cast<double>(x.rows());
  const Eigen::MatrixXf solved =
      normal.ldlt().solve(weighted.transpose() * table.targets.cast<double>()).cast<float>();
  baseline.layers.push_back(
      {.weight = solved.topRows(x.cols()).transpose(), .bias = solved.bottomRows(1).transpose()});
  return baseline;
}

Baseline FitMlp(const ActionSpace& space, const StepTable& training, const StepTable& held_out,
                int frames, const MlpFit& fit) {
  Baseline baseline = Unfitted(BaselineKind::kMlp, space, training, frames);
  const Rows rows(baseline, training);
  MlpTensors tensors = RandomMlp(rows.inputs.size(1), space.size(), fit);
  Train(space, rows, Rows(baseline, held_out), fit, &tensors);
  for (size_t i = 0; i < tensors.size(); i += 2) {
    const torch::Tensor weight = tensors[i].detach(), bias = tensors[i + 1].detach();
    baseline.layers.push_back(
        {.weight = Matrix::Map(weight.data_ptr<float>(), weight.size(0), weight.size(1)),
         .bias = Eigen::VectorXf::Map(bias.data_ptr<float>(), bias.size(0))});
  }
  return baseline;
}

}  // namespace spikeserve
