// What a policy may lose by rounding: the flags of the commands that write one in integers.
#pragma once

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "core/cli/program.h"
#include "train/evaluation/rounding_loss.h"

namespace spikeserve {

struct LossGate {
  double max_loss = 0.01;
  bool allow_loss = false;

  // Adds --max_loss and --allow_loss. `this` must outlive the command.
  void AddTo(FlagGroup flags);
  absl::Status Validate() const;
  // Returns FAILED_PRECONDITION, with `advice`, if more was lost and nobody allowed it.
  absl::Status Check(const RoundingLoss& loss, absl::string_view advice) const;
};

}  // namespace spikeserve
