// Value iteration on a grid: V(s) <- max_a E[r + discount * V(s')], V = 0 where an episode has
// ended.
//
// Gauss-Seidel: a sweep uses what it has just written, and sweeps alternate their direction, so
// that values travel all along a trajectory at once. Two things make large grids quick. A sweep
// over all choices is followed by a few that keep each state's best one (modified policy iteration:
// M. L. Puterman, M. C. Shin, Management Science 24(11), 1978). And a grid starts from the solution
// of a coarser one (one-way multigrid: C.-S. Chow, J. N. Tsitsiklis, IEEE Trans. Automatic Control
// 36(8), 1991).
#ifndef TRAIN_EXPERT_VALUE_ITERATION_H_
#define TRAIN_EXPERT_VALUE_ITERATION_H_

#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "train/expert/value_table.h"

namespace spikeserve {

struct SolveOptions {
  double tolerance = 1e-3;    // stop when a full sweep changes no value by more
  int coarsest = 4;           // the first grid has this many times fewer intervals, the next half
  int evaluation_sweeps = 8;  // between full sweeps
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
  }

  void Run() {
    while (Sweep([this](const State& state, uint8_t& best) {
             const auto decision = table_.Best(problem_, state);
             best = static_cast<uint8_t>(decision.choice);
             return decision.value;
           }) > options_.tolerance) {
      for (int i = 0; i < options_.evaluation_sweeps; ++i) {
        Sweep([this](const State& state, const uint8_t& best) {
          return table_.Backup(problem_, state, problem_.choices[best]);
        });
      }
    }
  }

 private:
  using State = typename ValueTable<D>::State;
  static constexpr uint8_t kTerminal = 255;

  // Sets every value to backup(state, best choice) and returns the largest change.
  template <typename BackupFunction>
  double Sweep(const BackupFunction& backup) {
    double change = 0.0;
    const size_t size = best_.size();
    for (size_t i = 0; i < size; ++i) {
      const size_t point = forward_ ? i : size - 1 - i;
      if (best_[point] == kTerminal) continue;
      const double value = backup(table_.grid.StateAt(point), best_[point]);
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
};

// REQUIRES: options.coarsest is a power of two.
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

#endif  // TRAIN_EXPERT_VALUE_ITERATION_H_
