// Experts for Acrobot. Their value table is the number of steps to the goal, solved on 72 x 72 x 57
// x 57 points. Such a coarse table ranks states well but estimates their values poorly: beam
// search, which uses only the ranking, is close to the optimum; lookahead of depth 4 is worse, and
// one-step greedy is worst.
#include <algorithm>
#include <memory>
#include <numbers>
#include <utility>
#include <vector>

#include "core/base/status_macros.h"
#include "core/environment/classic_tasks.h"
#include "train/expert/beam_search.h"
#include "train/expert/experts.h"
#include "train/expert/lookahead_expert.h"
#include "train/expert/table_file.h"

namespace spikeserve {
namespace {

using std::numbers::pi;

// Follows its plan while the states equal the predicted ones bit for bit; otherwise makes a new
// plan.
class BeamExpert final : public Expert {
 public:
  BeamExpert(Problem problem, std::shared_ptr<const ValueTable<4>> table, int width)
      : problem_(std::move(problem)), table_(std::move(table)), width_(width) {}

  Action Act(absl::Span<const double> state) override {
    if (next_ == plan_.size() || state != absl::MakeConstSpan(foreseen_)) {
      std::copy_n(state.begin(), foreseen_.size(), foreseen_.begin());
      plan_ = BeamSearch(problem_, *table_, foreseen_, width_, problem_.model->max_episode_steps());
      if (plan_.empty()) plan_ = {table_->Best(problem_, foreseen_).choice};
      next_ = 0;
    }
    const Action& action = problem_.choices[plan_[next_++]].action;
    problem_.model->Advance(action, absl::MakeSpan(foreseen_));
    return action;
  }

  // Uses the table's values: its ranking is good enough to show in which states a choice matters.
  double StateImportance(absl::Span<const double> state) override {
    Grid<4>::State start;
    std::copy_n(state.begin(), start.size(), start.begin());
    return table_->StateImportance(problem_, start);
  }

  std::unique_ptr<Expert> Clone() const override {
    return std::make_unique<BeamExpert>(problem_, table_, width_);
  }

 private:
  Problem problem_;
  std::shared_ptr<const ValueTable<4>> table_;
  int width_;
  std::vector<int> plan_;         // indices of choices
  size_t next_ = 0;               // the next step of the plan
  Grid<4>::State foreseen_ = {};  // the predicted state at the beginning of that step
};

}  // namespace

absl::StatusOr<std::unique_ptr<Expert>> MakeAcrobotExpert(const ExpertOptions& options) {
  const bool beam = options.name.empty() || options.name == "beam";
  if (!beam && options.name != "lookahead" && options.name != "greedy") {
    return UnknownExpert(options, "beam, lookahead or greedy");
  }
  Problem problem = {.model = MakeAcrobot(), .choices = {}};
  for (int torque = 0; torque < 3; ++torque) {
    problem.choices.push_back(Choice::Of({.discrete = torque, .continuous = {}}));
  }
  // The axes cover half of the possible velocities, which makes the grid twice as fine. Higher
  // velocities do not occur on the way up.
  const Axes<4> axes = {
      {{-pi, pi, 72, true}, {-pi, pi, 72, true}, {-2 * pi, 2 * pi, 57}, {-4 * pi, 4 * pi, 57}}};
  ASSIGN_OR_RETURN(ValueTable<4> solved, LoadOrSolve<4>(options, "acrobot_swing_up", problem, axes,
                                                        {.tolerance = 0.05,
                                                         .coarsest = 2,
                                                         .evaluation_sweeps = 4,
                                                         .most_sweeps = 24,
                                                         .keep_successors = true}));
  auto table = std::make_shared<const ValueTable<4>>(std::move(solved));
  if (beam) {
    return std::make_unique<BeamExpert>(std::move(problem), std::move(table), options.beam_width);
  }
  return std::make_unique<LookaheadExpert<4>>(std::move(problem), std::move(table),
                                              /*depth=*/options.name == "lookahead" ? 4 : 1);
}

}  // namespace spikeserve
