#include "train/baselines/imitation_error.h"

#include <cmath>
#include <limits>

#include "core/action/action_head.h"
#include "core/engine/factory/engine_factory.h"
#include "train/data/dataset.h"

namespace spikeserve {
namespace {

// Returns the errors of all steps: [rows, act] for a Box, [rows, 1] for a Discrete space.
Eigen::MatrixXd StepErrors(const ActionSpace& space, const RowMajorMatrix<float>& outputs,
                           const RowMajorMatrix<float>& targets) {
  if (!space.is_discrete()) return (outputs - targets).cast<double>().array().square();
  Eigen::MatrixXd errors(outputs.rows(), 1);
  for (Eigen::Index row = 0; row < outputs.rows(); ++row) {
    Eigen::Index chosen = 0, wanted = 0;
    outputs.row(row).maxCoeff(&chosen);
    targets.row(row).maxCoeff(&wanted);
    errors(row, 0) = chosen == wanted ? 0.0 : 1.0;
  }
  return errors;
}

// Returns the encoded actions of a policy on the steps of an episode, from row `row` of `outputs`
// on.
void Decide(const Engine& engine, const Episode& episode, Eigen::Index row,
            RowMajorMatrix<float>* outputs) {
  const Policy& policy = engine.policy();
  const auto obs = static_cast<size_t>(policy.observation_size());
  const std::vector<float> returns = ReturnsToGo(episode);
  const auto context = engine.NewContext();
  Engine::Output output;
  ActionChoice choice;
  std::vector<float> encoded(static_cast<size_t>(policy.action_space.size()));
  for (int step = 0; step < episode.steps(); ++step, ++row) {
    const auto begin = static_cast<size_t>(step) * obs;
    engine.Decide(*context, returns[step],
                  absl::MakeConstSpan(episode.observations).subspan(begin, obs), &output);
    ChooseAction(policy.weights.head, policy.action_space, output.readout, {}, 0, &choice);
    policy.action_space.Encode(choice.action, absl::MakeSpan(encoded));
    outputs->row(row) = AsVector(encoded).transpose();
    policy.action_space.Encode(episode.actions[step], absl::MakeSpan(encoded));
    engine.AppendAction(*context, encoded);
  }
}

double ExplainedShare(double error, double of_constant) {
  if (error <= 0.0) return 1.0;
  return of_constant > 0.0 ? 1.0 - error / of_constant : 0.0;
}

// Returns the outputs of the best constant action: the mean of the targets, which for a Discrete
// space are one-hot.
RowMajorMatrix<float> ConstantOutputs(const StepTable& table) {
  const Eigen::RowVectorXf mean = table.weights.transpose() * table.targets / table.weights.sum();
  return mean.replicate(table.targets.rows(), 1);
}

}  // namespace

ImitationError ErrorOf(const ActionSpace& space, const RowMajorMatrix<float>& outputs,
                       const StepTable& table) {
  const Eigen::MatrixXd errors = StepErrors(space, outputs, table.targets);
  const Eigen::VectorXd weights = table.weights.cast<double>();
  const Eigen::VectorXd steps = errors.rowwise().mean().cwiseProduct(weights);
  ImitationError error;
  if (weights.sum() <= 0.0) {
    error.mean = error.explained = std::numeric_limits<double>::quiet_NaN();
    return error;
  }
  error.mean = steps.sum() / weights.sum();
  const Eigen::VectorXd elements = errors.transpose() * weights / weights.sum();
  const Eigen::VectorXd constant =
      StepErrors(space, ConstantOutputs(table), table.targets).transpose() * weights /
      weights.sum();
  error.explained = ExplainedShare(error.mean, constant.mean());
  for (Eigen::Index i = 0; !space.is_discrete() && i < elements.size(); ++i) {
    error.elements.push_back(elements[i]);
    error.explained_elements.push_back(ExplainedShare(elements[i], constant[i]));
  }
  for (size_t i = 0; i + 1 < table.begins.size(); ++i) {
    const int begin = table.begins[i], count = table.begins[i + 1] - begin;
    const double weight = weights.segment(begin, count).sum();
    if (weight > 0.0) error.episodes.push_back(steps.segment(begin, count).sum() / weight);
  }
  return error;
}

ImitationError ErrorOf(std::shared_ptr<const Policy> policy, const StepTable& table) {
  const ActionSpace space = policy->action_space;
  const std::unique_ptr<Engine> engine = MakeEngine(std::move(policy));
  RowMajorMatrix<float> outputs(table.rows(), space.size());
  for (size_t i = 0; i < table.episodes.size(); ++i) {
    Decide(*engine, table.episodes[i], table.begins[i], &outputs);
  }
  return ErrorOf(space, outputs, table);
}

MeanDifference Compare(const std::vector<double>& a, const std::vector<double>& b) {
  if (a.empty() || a.size() != b.size()) return {0.0, std::numeric_limits<double>::infinity()};
  const Eigen::ArrayXd differences = AsVector(a) - AsVector(b);
  const auto count = static_cast<double>(differences.size());
  const double mean = differences.mean();
  if (count < 2.0) return {mean, std::numeric_limits<double>::infinity()};
  const double variance = (differences - mean).square().sum() / (count - 1.0);
  return {mean, std::sqrt(variance / count)};
}

MeanDifference Compare(const ImitationError& a, const ImitationError& b) {
  return Compare(a.episodes, b.episodes);  // one of them may have no step with a weight
}

}  // namespace spikeserve
