// A value function on a grid, and lookahead search with the exact model that uses it.
//
// Immutable once solved; const members are safe to call from many threads.
#pragma once

#include <algorithm>
#include <limits>
#include <memory>
#include <vector>

#include "absl/types/span.h"
#include "core/environment/classic_control.h"
#include "train/expert/grid.h"

namespace spikeserve {

// An action to choose, and the actions that may be executed in its place, all with equal
// probability. Without a disturbance `executed` holds the action itself.
struct Choice {
  Action action;
  std::vector<Action> executed;

  static Choice Of(Action action) { return {action, {action}}; }
};

// A decision problem: maximise the sum over t of discount^t r_t.
struct Problem {
  std::shared_ptr<const ClassicControl> model;
  std::vector<Choice> choices;
  double discount = 1.0;
};

template <int D>
struct ValueTable {
  using State = typename Grid<D>::State;

  Grid<D> grid;
  std::vector<float> values;  // [grid.size()]

  double operator()(const State& state) const { return grid.Interpolate(values, state); }

  // Returns the right-hand side of Bellman's equation for one choice: the mean over its executed
  // actions of r + discount * max over the next choices. Searches `depth` steps ahead and takes the
  // values of the last states from the table. REQUIRES: depth >= 1.
  double Backup(const Problem& problem, const State& state, const Choice& choice,
                int depth = 1) const {
    double sum = 0.0;
    for (const Action& action : choice.executed) {
      State next = state;
      sum += problem.model->Advance(action, absl::MakeSpan(next));
      if (problem.model->IsTerminal(next)) continue;
      sum += problem.discount * (depth == 1 ? (*this)(next) : Best(problem, next, depth - 1).value);
    }
    return sum / static_cast<double>(choice.executed.size());
  }

  // Returns the value of the best choice minus the value of the worst one.
  double StateImportance(const Problem& problem, const State& state, int depth = 1) const {
    double best = -std::numeric_limits<double>::infinity(), worst = -best;
    for (const Choice& choice : problem.choices) {
      const double value = Backup(problem, state, choice, depth);
      best = std::max(best, value);
      worst = std::min(worst, value);
    }
    return best - worst;
  }

  struct Decision {
    int choice = 0;
    double value = -std::numeric_limits<double>::infinity();
  };

  // Returns the choice with the largest backup; the first one of several that are equal.
  Decision Best(const Problem& problem, const State& state, int depth = 1) const {
    Decision best;
    for (size_t i = 0; i < problem.choices.size(); ++i) {
      const double value = Backup(problem, state, problem.choices[i], depth);
      if (value > best.value) best = {static_cast<int>(i), value};
    }
    return best;
  }
};

}  // namespace spikeserve
