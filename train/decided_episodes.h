// The episodes by which a subcommand of spiketrain measures a policy: those that it plays, or those
// that a server has recorded.
#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "core/cli/program.h"
#include "core/model/policy.h"
#include "train/evaluation/evaluation.h"

namespace spikeserve {

struct DecidedEpisodesFlags {
  std::string recordings;  // empty: the policy plays
  EvaluationOptions options;

  // Adds --recordings to the flags of `section`, and the flags for playing in a section of their
  // own. `this` must outlive the command.
  void AddTo(const Command& command, const char* section);
};

// Returns what the decisions of the episodes cost. Errors name the flag.
absl::StatusOr<Evaluation> Decide(const DecidedEpisodesFlags& flags,
                                  const std::shared_ptr<const Policy>& policy);

// Reads the policy file of --policy, or names the flag in an error.
absl::StatusOr<std::shared_ptr<const Policy>> ReadRequiredPolicy(const std::string& path);

}  // namespace spikeserve
