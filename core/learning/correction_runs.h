// What operators have taught a private head lately, so that an operator's share of it can be taken
// out again.
//
//   runs.Add("ann", now, head, measured);              // before a correction changes the head
//   const auto undone = runs.Undo("ann", now - 60.0, &head, &measured);
//
// A run is what one operator taught in up to kSeconds without another one in between, with the head
// before it. So the head without some runs is that before the first of them, plus the changes of
// the others: bit for bit as before, if no other operator has followed.
//
// A plain value, whose size is bounded.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "Eigen/Core"
#include "absl/strings/string_view.h"
#include "core/learning/correction.h"

namespace spikeserve {

struct CorrectionRun {
  std::string operator_id;
  double began = 0.0;  // times are seconds since 1970
  double ended = 0.0;
  int64_t updates = 0;
  Eigen::VectorXf before;  // [act * d]: W - W_base
  Corrections measured;    // before it
};

struct CorrectionRuns {
  static constexpr size_t kMost = 8;  // that are kept: with kSeconds, two minutes at least
  static constexpr double kSeconds = 15.0;

  std::vector<CorrectionRun> runs;  // oldest first
  double forgotten = 0.0;  // end of the last run that the head may have and `runs` has not; 0: none

  // Notes that an operator's correction is about to change `head`, which was `measured` so far.
  void Add(absl::string_view operator_id, double now, const Eigen::VectorXf& head,
           const Corrections& measured);
  // The head has become another one, with an unknown share of the runs.
  void Forget();
  // Takes the runs of an operator that ended at `since` or later out of `head`, and puts `measured`
  // back to before the first of them, except for its counts. Returns the number of their updates;
  // nullopt, and changes nothing, if it does not have all runs since then.
  std::optional<int64_t> Undo(absl::string_view operator_id, double since, Eigen::VectorXf* head,
                              Corrections* measured);
};

}  // namespace spikeserve
