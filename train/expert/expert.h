// Controllers that play the expert when offline data are recorded.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"

namespace spikeserve {

// Not thread-safe. A clone shares the immutable value tables and may be used on another thread.
class Expert {
 public:
  virtual ~Expert() = default;

  // Starts an episode. REQUIRES: called before the first Act() of every episode. `key` seeds the
  // expert's random draws. Returns the return that the expert aims for in this episode, or nullopt
  // for an expert without such a target.
  virtual std::optional<double> BeginEpisode(uint64_t /*key*/) { return std::nullopt; }

  // Returns the action in an environment's internal `state` (Environment::state()). A pure function
  // of `state`, with two exceptions: the beam search expert follows its plan while the states are
  // those it predicted, and the return-conditioned expert counts its steps.
  virtual Action Act(absl::Span<const double> state) = 0;

  // Returns how much the choice in `state` matters: the value of the best action minus the value of
  // the worst one (L. Torrey, M. Taylor, AAMAS 2013). Returns 1 for an expert that does not know
  // these values.
  virtual double StateImportance(absl::Span<const double> /*state*/) { return 1.0; }

  virtual std::unique_ptr<Expert> Clone() const = 0;
};

struct ExpertOptions {
  std::string environment = "CartPole-v1";
  // The expert's name. CartPole-v1: feedback, return_conditioned. MountainCar-v0: value_iteration,
  // return_conditioned. Pendulum-v1: value_iteration, robust, cautious. Acrobot-v1: beam,
  // lookahead, greedy. Empty selects the first name of the environment's list.
  std::string name = {};
  // Directory of the solved value tables. A table is read if its file exists, and otherwise solved
  // and written. Empty: tables are always solved and never written.
  std::string tables_directory = {};
  int beam_width = 5000;  // of the beam expert: partial plans kept after each step
  // Divides the number of intervals of every axis of a table: 1, 2, 4 or 8. 1 is the full table; 8
  // is for quick tests.
  int coarsening = 1;

  absl::Status Validate() const;
};

// Creates an expert; reads or solves the value tables it needs, which takes seconds to minutes.
// Returns NOT_FOUND, with the known names, for an unknown environment or expert.
absl::StatusOr<std::unique_ptr<Expert>> MakeExpert(const ExpertOptions& options);

}  // namespace spikeserve
