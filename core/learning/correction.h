// Learning from the steps in which an operator acted in the policy's place: the rule of least mean
// squares, normalised (Widrow and Hoff 1960; Nagumo and Noda 1967), on the weights of the action
// head.
//
//   dW = eta g e (x) r / |r|^2
//   Discrete: e = onehot(executed) - softmax(z); zero if z is largest at the executed action
//   Box: e = unit - tanh(z), where `unit` is the executed action mapped from its bounds to [-1, 1]
//
// r are the readout rates, and z the logits of the head as it is now. So the third factor is how
// far the policy was from the operator: a step on which they agree changes nothing. With eta 1, a
// Box's action near zero would be the operator's the next time.
//
// g in [0, 1] is how far the head at the start was from the operator over all corrected steps. A
// policy that is right most of the time is hardly changed, because what is fitted to the steps on
// which it is not costs more elsewhere than it gains (docs/design/learning.md).
//
// Plain values; free functions, safe to call from many threads.
#pragma once

#include <algorithm>
#include <cstdint>

#include "Eigen/Core"
#include "core/action/action_space.h"

namespace spikeserve {

// Returns what a head with the logits [act] does, [act]: probabilities, or values in [-1, 1].
// REQUIRES: `logits` belong to `space` and are finite.
Eigen::VectorXf Prediction(const ActionSpace& space, const Eigen::VectorXf& logits);
// Returns the operator's action likewise. REQUIRES: `executed` belongs to `space`.
Eigen::VectorXf Target(const ActionSpace& space, const Action& executed);

// Returns whether a head with these logits acts as the operator did, so that there is nothing to
// learn. Never true of a Box.
bool AgreesWith(const ActionSpace& space, const Eigen::VectorXf& logits, const Action& executed);

// How well a head predicts operators, beside the head that it started from. Each step is measured
// before it is learned from (progressive validation; Blum, Kalai and Langford 1999). The sums
// forget: a step counts for about kMemory others.
struct Corrections {
  int64_t steps = 0;         // of operators
  int64_t in_episode = 0;    // those of the running episode
  int64_t measured = 0;      // since the head was put back
  double error = 0.0;        // sum of |e|^2
  double start_error = 0.0;  // the same of the head that it started from
  double size = 0.0;         // sum of |target|^2 + |prediction of that head|^2

  static constexpr double kMemory = 1000.0;
  static constexpr int64_t kLeast = 20;  // steps before the two are compared

  void Measure(double squared_error, double squared_start_error, double squared_size) {
    constexpr double kept = 1.0 - 1.0 / kMemory;
    ++measured;
    error = kept * error + squared_error;
    start_error = kept * start_error + squared_start_error;
    size = kept * size + squared_size;
  }
  // Returns whether what was learned predicts worse than nothing learned.
  bool DoesHarm() const { return measured >= kLeast && error > start_error; }
  void PutBack() {
    measured = 0;
    error = start_error;
  }

  // Return how far a head is from the operators: 0 if it acts as they do, about 1 if the two have
  // nothing to do with each other, and up to 2 if they are opposite.
  double Disagreement() const { return size > 0.0 ? error / size : 0.0; }
  double StartDisagreement() const { return size > 0.0 ? start_error / size : 0.0; }
  // Returns g: (2 StartDisagreement())^3, at most 1.
  double Weight() const {
    const double half = std::min(1.0, 2.0 * StartDisagreement());
    return half * half * half;
  }

  friend bool operator==(const Corrections&, const Corrections&) = default;
};

}  // namespace spikeserve
