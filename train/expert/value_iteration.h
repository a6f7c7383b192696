// Value iteration on a grid: V(s) <- max_a E[r + discount * V(s')], with V = 0 in terminal states.
//
// The sweeps are of Gauss-Seidel type: each uses the values it has just written, and the direction
// alternates, so that values propagate along a whole trajectory in one sweep. Two methods speed up
// large grids. A full sweep, over all choices, is followed by a few sweeps that evaluate only the
// best choice of each state (modified policy iteration: M. L. Puterman, M. C. Shin, Management
// Science 24(11), 1978). And the values of a grid are initialised from the solution on a coarser
// one (one-way multigrid: C.-S. Chow, J. N. Tsitsiklis, IEEE Trans. Automatic Control 36(8), 1991).
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "train/expert/value_table.h"

namespace spikeserve {

struct SolveOptions {
  double tolerance = 1e-3;  // stops when a full sweep changes no value by more than this
  int coarsest = 4;  // the first grid has this factor fewer intervals; each next one halves it
  int evaluation_sweeps = 8;  // sweeps with fixed choices between two full sweeps
  // Largest number of full sweeps per grid. It bounds the cost of states from which an undiscounted
  // problem never ends on that grid.
  int most_sweeps = std::numeric_limits<int>::max();
  // Stores the successor states once instead of computing them with the model in every sweep.
  // Faster if the model is slow; costs 4 (D + 2) bytes per grid point and executed action.
  bool keep_successors = false;
};

template <int D>
class ValueIteration {
 public:
  // REQUIRES: at most 255 choices.
  ValueIteration(const Problem& problem, const SolveOptions& options, ValueTable<D>* table)
      : problem_(problem), options_(options), table_(*table), best_(table->grid.size()) {
    for (size_t point = 0; point < best_.size(); ++point) {
      if (problem.model->IsTerminal(table_.grid.StateAt(point))) {
        best_[point] = kTerminal;
        table_.values[point] = 0.0f;
      }
    }
    if (options.keep_successors) KeepSuccessors();
  }

  void Run() {
    for (int sweep = 1; FullSweep() > options_.tolerance && sweep < options_.most_sweeps; ++sweep) {
      for (int i = 0; i < options_.evaluation_sweeps; ++i) {
        Sweep([this](size_t point) { return Backup(point, best_[point]); });
      }
    }
  }

 private:
  using State = typename ValueTable<D>::State;
  static constexpr uint8_t kTerminal = 255;

  // The result of one executed action at one grid point.
  struct Successor {
    std::array<float, D> state;
    float reward;
    float discount;  // 0 if the episode ends
  };

  void KeepSuccessors() {
    for (const Choice& choice : problem_.choices) {
      first_.push_back(actions_.size());
      actions_.insert(actions_.end(), choice.executed.begin(), choice.executed.end());
    }
    first_.push_back(actions_.size());
    successors_.reserve(best_.size() * actions_.size());
    for (size_t point = 0; point < best_.size(); ++point) {
      for (const Action& action : actions_) {
        State state = table_.grid.StateAt(point);
        Successor& next = successors_.emplace_back();
        next.reward = static_cast<float>(problem_.model->Advance(action, absl::MakeSpan(state)));
        next.discount =
            problem_.model->IsTerminal(state) ? 0.0f : static_cast<float>(problem_.discount);
        std::copy(state.begin(), state.end(), next.state.begin());
      }
    }
  }

  // Same as ValueTable::Backup with depth 1, but uses the stored successors if there are any.
  double Backup(size_t point, size_t choice) const {
    if (successors_.empty()) {
      return table_.Backup(problem_, table_.grid.StateAt(point), problem_.choices[choice]);
    }
    double sum = 0.0;
    const Successor* of_point = &successors_[point * actions_.size()];
    for (size_t i = first_[choice]; i < first_[choice + 1]; ++i) {
      const Successor& next = of_point[i];
      sum += static_cast<double>(next.reward);
      if (next.discount == 0.0f) continue;
      State state;
      std::copy(next.state.begin(), next.state.end(), state.begin());
      sum += static_cast<double>(next.discount) * table_(state);
    }
    return sum / static_cast<double>(first_[choice + 1] - first_[choice]);
  }

  // Sets every value to its best backup over all choices, stores that choice, and returns the
  // largest change.
  double FullSweep() {
    return Sweep([this](size_t point) {
      double most = -std::numeric_limits<double>::infinity();
      for (size_t choice = 0; choice < problem_.choices.size(); ++choice) {
        const double value = Backup(point, choice);
        if (value <= most) continue;
        most = value;
        best_[point] = static_cast<uint8_t>(choice);
      }
      return most;
    });
  }

  // Sets every value to backup(point) and returns the largest change.
  template <typename BackupFunction>
  double Sweep(const BackupFunction& backup) {
    double change = 0.0;
    const size_t size = best_.size();
    for (size_t i = 0; i < size; ++i) {
      const size_t point = forward_ ? i : size - 1 - i;
      if (best_[point] == kTerminal) continue;
      const double value = backup(point);
      change = std::max(change, std::abs(value - table_.values[point]));
      table_.values[point] = static_cast<float>(value);
    }
    forward_ = !forward_;
    return change;
  }

  const Problem& problem_;
  const SolveOptions& options_;
  ValueTable<D>& table_;
  std::vector<uint8_t> best_;  // index of the best choice of each point, or kTerminal
  bool forward_ = true;
  // Only with keep_successors: the executed actions of all choices, concatenated; the index in
  // `actions_` of each choice's first action, and one past the end; and the successors, [points,
  // actions].
  std::vector<Action> actions_;
  std::vector<size_t> first_;
  std::vector<Successor> successors_;
};

// Solves `problem` on the grid of `axes` and returns the values. REQUIRES: options.coarsest is a
// power of two.
template <int D>
ValueTable<D> SolveValueTable(const Problem& problem, const Axes<D>& axes,
                              const SolveOptions& options) {
  ValueTable<D> solved = {Grid<D>(axes), {}};
  for (int factor = options.coarsest; factor >= 1; factor /= 2) {
    Axes<D> coarse = axes;
    for (Axis& axis : coarse) axis = axis.Coarser(factor);
    ValueTable<D> table = {Grid<D>(coarse), {}};
    table.values.resize(table.grid.size());
    if (!solved.values.empty()) {
      for (size_t point = 0; point < table.values.size(); ++point) {
        table.values[point] = static_cast<float>(solved(table.grid.StateAt(point)));
      }
    }
    ValueIteration<D>(problem, options, &table).Run();
    solved = std::move(table);
  }
  return solved;
}

}  // namespace spikeserve
