// How far the actions of a model are from those to imitate, on recorded steps.
//
// Functions are pure and safe to call from many threads.
#pragma once

#include <memory>
#include <vector>

#include "core/model/policy.h"
#include "train/baselines/step_table.h"

namespace spikeserve {

// The error of a step is the share of wrong actions for a Discrete space, which is 0 or 1, and for
// a Box the mean over its elements of the squared difference of the encoded actions, whose bounds
// are -1 and 1. Means are weighted by the weights of the steps in the loss.
struct ImitationError {
  double mean = 0.0;             // NaN if no step has a weight
  std::vector<double> elements;  // [act] for a Box: the means of each element; empty if Discrete
  std::vector<double> episodes;  // the means of each episode of the table
  // The share of the actions that the model explains, at most 1: 1 less its error divided by that
  // of the best constant action. 1 without any error; 0, or NaN without a weight, if there is
  // nothing to explain.
  double explained = 0.0;
  std::vector<double> explained_elements;  // as `elements`
};

// Returns the error of `outputs` [rows, act]: encoded actions of a Box, or scores of which the
// largest is the action.
ImitationError ErrorOf(const ActionSpace& space, const RowMajorMatrix<float>& outputs,
                       const StepTable& table);

// Returns the error of a policy that is shown the recorded observations, actions and
// returns-to-go, and computed by the engine of the server.
ImitationError ErrorOf(std::shared_ptr<const Policy> policy, const StepTable& table);

// A mean difference of two models on the same episodes; 0 and infinity without any.
struct MeanDifference {
  double mean = 0.0;            // first minus second
  double standard_error = 0.0;  // infinite for a single episode
  bool is_significant() const { return mean > 2.0 * standard_error; }
};
// Of values of each episode.
MeanDifference Compare(const std::vector<double>& a, const std::vector<double>& b);
// Of errors: positive if `b` is better.
MeanDifference Compare(const ImitationError& a, const ImitationError& b);

}  // namespace spikeserve
