// The subcommands of spiketrain.
//
// Each function adds one to `program`: its flags, and an action. Errors name the flag or the file
// that is wrong.
#ifndef TRAIN_COMMANDS_H_
#define TRAIN_COMMANDS_H_

#include "core/cli/program.h"

namespace spikeserve {

// Records a dataset and writes it to --out.
void AddDatasetCommand(Program& program);

// Plays the expert of --env and prints its mean return.
void AddExpertCommand(Program& program);

// Trains a policy, evaluates it, and writes policy.safetensors and checkpoint.pt into --out. The
// policy file holds the command line.
void AddTrainCommand(Program& program);

// Plays --policy in closed loop.
void AddEvalCommand(Program& program);

// Trains what is missing of the paper's experiments in --out and writes report.md and report.html
// there. The report holds the command line.
void AddReportCommand(Program& program);

}  // namespace spikeserve

#endif  // TRAIN_COMMANDS_H_
