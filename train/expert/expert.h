// Controllers that stand for an expert in offline data.
#ifndef TRAIN_EXPERT_EXPERT_H_
#define TRAIN_EXPERT_EXPERT_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "core/action/action_space.h"

namespace spikeserve {

// Not thread-safe; a clone shares the tables, which are immutable, and may live on another thread.
class Expert {
 public:
  virtual ~Expert() = default;

  // To be called before the first action of an episode. `key` decides what there is to draw.
  // Returns the return the expert is asked for, if it is one that is asked.
  virtual std::optional<double> BeginEpisode(uint64_t /*key*/) { return std::nullopt; }

  // The action in an environment's internal `state` (Environment::state()); a pure function of it
  // for all but the planner, which keeps to its plan while the states are those it foresaw, and
  // the dial, which counts its steps.
  virtual Action Act(absl::Span<const double> state) = 0;

  // What the worst action in `state` loses against the best one, where the expert knows: how much
  // the choice matters. 1 where it does not.
  virtual double Stakes(absl::Span<const double> /*state*/) { return 1.0; }

  virtual std::unique_ptr<Expert> Clone() const = 0;
};

struct ExpertOptions {
  std::string environment = "CartPole-v1";
  // CartPole-v1: feedback, dial. MountainCar-v0: value_iteration, dial. Pendulum-v1:
  // value_iteration, robust, cautious. Acrobot-v1: beam, lookahead, greedy. Empty for the first of
  // these.
  std::string name = {};
  // Value tables are kept here and read when they are there; empty: solved anew, and not kept.
  std::string tables_directory = {};
  int beam_width = 5000;  // beam: partial plans that survive a step
  // Divides the number of intervals of every axis: 1 is the full table, 8 is for quick tests.
  int coarsening = 1;

  absl::Status Validate() const;
};

// Solves or reads the tables the expert needs: seconds to minutes. NOT_FOUND names the environments
// or experts there are.
absl::StatusOr<std::unique_ptr<Expert>> MakeExpert(const ExpertOptions& options);

}  // namespace spikeserve

#endif  // TRAIN_EXPERT_EXPERT_H_
