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
  double tolerance = 1e-3;    // stop when a full sweep changes no value by more
  int coarsest = 4;           // the first grid has this many times fewer intervals, the next half
  int evaluation_sweeps = 8;  // between full sweeps
  // Full sweeps of a grid at most, which bounds the cost of states from where an undiscounted
  // problem on that grid never ends.
  int most_sweeps = std::numeric_limits<int>::max();
  // Keep where every choice leads instead of asking the model at every sweep: quicker where that is
  // slow, for 4 (D + 2) bytes a point and executed action.
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

  // Where one executed action leads from a point.
  struct Successor {
    std::array<float, D> state;
    float reward;
    float discount;  // 0 where the episode ends
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

  // As ValueTable::Backup, from what is kept if it is.
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

  // Chooses anew everywhere.
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
  // With keep_successors: all choices' executed actions one after the other, where each choice's
  // begin, and [points, actions] where they lead.
  std::vector<Action> actions_;
  std::vector<size_t> first_;
  std::vector<Successor> successors_;
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
