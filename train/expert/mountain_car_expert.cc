// Experts for MountainCar: one step of lookahead on a value table of the number of steps to the
// goal, solved on 1801 x 1401 points.
#include <memory>
#include <utility>

#include "core/base/status_macros.h"
#include "core/environment/classic_tasks.h"
#include "train/expert/experts.h"
#include "train/expert/lookahead_expert.h"
#include "train/expert/table_file.h"
#include "train/expert/target_length_expert.h"

namespace spikeserve {

absl::StatusOr<std::unique_ptr<Expert>> MakeMountainCarExpert(const ExpertOptions& options) {
  const bool is_conditioned = options.name == "return_conditioned";
  if (!is_conditioned && !options.name.empty() && options.name != "value_iteration") {
    return UnknownExpert(options, "value_iteration or return_conditioned");
  }
  Problem problem = {.model = MakeMountainCar(), .choices = {}};
  for (int push = 0; push < 3; ++push) {
    problem.choices.push_back(Choice::Of({.discrete = push, .continuous = {}}));
  }
  ASSIGN_OR_RETURN(ValueTable<2> table,
                   LoadOrSolve<2>(options, "mountain_car", problem,
                                  {{{-1.2, 0.6, 1801}, {-0.07, 0.07, 1401}}}, {.tolerance = 1e-3}));
  auto shortest = std::make_unique<LookaheadExpert<2>>(
      problem, std::make_shared<const ValueTable<2>>(std::move(table)), /*depth=*/1);
  if (!is_conditioned) return shortest;
  auto coast = std::make_unique<ConstantExpert>(Action{.discrete = 1, .continuous = {}});
  return std::make_unique<TargetLengthExpert>(problem.model, /*reward=*/-1.0, std::move(coast),
                                              std::move(shortest),
                                              EpisodeLengths{.least = 90, .most = 200});
}

}  // namespace spikeserve
