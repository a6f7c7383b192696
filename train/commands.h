// The subcommands of spiketrain, each reading its flags; every error names the flag or the file it
// is about.
#ifndef TRAIN_COMMANDS_H_
#define TRAIN_COMMANDS_H_

#include <string>

#include "absl/status/status.h"

namespace spikeserve {

// Records a dataset and writes it to --out.
absl::Status DatasetCommand();

// Plays the expert of --env and prints its mean return.
absl::Status ExpertCommand();

// Trains a policy, evaluates it, and writes policy.safetensors and checkpoint.pt into --out.
// `command_line` goes into the policy file.
absl::Status TrainCommand(const std::string& command_line);

// Plays --policy in closed loop.
absl::Status EvalCommand();

// Trains what is missing of the paper's experiments in --out and writes report.md and report.html
// there. `command_line` goes into the report.
absl::Status ReportCommand(const std::string& command_line);

}  // namespace spikeserve

#endif  // TRAIN_COMMANDS_H_
