// Estimates the return of a policy from episodes that another policy has played.
//
// Two estimators, both without a discount: weighted per-decision importance sampling (Precup,
// Sutton and Singh, "Eligibility traces for off-policy policy evaluation", 2000) and the weighted
// doubly robust estimator (Thomas and Brunskill, "Data-efficient off-policy policy evaluation for
// reinforcement learning", 2016), whose Q is linear in the actions and in products of the
// observations, and is fitted to other episodes than those that it is applied to.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "core/math/vector_view.h"

namespace spikeserve {

// An episode of T steps, as the estimators see it. An action is described by K numbers, in which Q
// is linear: its one-hot code, or 1 and each element of a Box, in [-1, 1], with its square.
struct OffPolicyEpisode {
  size_t unit = 0;                        // episodes of one unit may depend on each other
  std::vector<double> rewards = {};       // [T]
  std::vector<double> log_ratios = {};    // [T]: log of new over recorded probability of the action
  RowMajorMatrix<double> state = {};      // [T, S]: observation, step, return-to-go
  RowMajorMatrix<double> taken = {};      // [T, K]: of the action that was answered
  RowMajorMatrix<double> recorded = {};   // [T, K]: mean over the actions of the recorded policy
  RowMajorMatrix<double> evaluated = {};  // [T, K]: mean over the actions of the new policy
};

// An estimate with its interval of 95 %, from the spread of the units by the delta method and
// Student's t with as many degrees of freedom as episodes are effective.
struct OffPolicyInterval {
  double value = 0.0;
  double low = 0.0;
  double high = 0.0;
};

struct OffPolicyEstimate {
  OffPolicyInterval new_return = {};
  OffPolicyInterval difference = {};  // from the recorded policy
};

// Fewer effective episodes, or units, than these can tell nothing: the spread of the weights is not
// known from them.
inline constexpr double kFewestEffective = 40.0;
inline constexpr size_t kFewestUnits = 20;

struct OffPolicyEvaluation {
  size_t episodes = 0;
  size_t units = 0;
  double recorded_return = 0.0;  // mean of the episodes
  OffPolicyEstimate importance_sampling = {};
  OffPolicyEstimate doubly_robust = {};
  // [longest T]: how many episodes of the new policy the episodes are worth up to each step: the
  // square of the sum of their weights over the sum of the squares (Kong, 1992).
  std::vector<double> effective_by_step = {};
  std::vector<double> weights =
      {};  // [episodes]: the products of all ratios, divided by their mean

  double effective() const { return effective_by_step.back(); }
  bool can_tell() const { return effective() >= kFewestEffective && units >= kFewestUnits; }
  // Returns better, worse or "no clear difference", by the doubly robust interval, or "cannot
  // tell".
  std::string verdict() const;
};

// REQUIRES: at least two episodes, each of at least one step; equal S and K.
OffPolicyEvaluation EvaluateOffPolicy(const std::vector<OffPolicyEpisode>& episodes);

}  // namespace spikeserve
