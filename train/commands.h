// The subcommands of spiketrain.
//
// Each function adds one subcommand to `program`, with its flags and its action. Errors name the
// flag or the file.
#pragma once

#include "core/cli/program.h"

namespace spikeserve {

// Records a dataset and writes it to --out.
void AddDatasetCommand(Program& program);

// Plays the expert of --env and prints its mean return.
void AddExpertCommand(Program& program);

// Trains a policy, evaluates it, and writes policy.safetensors and checkpoint.pt to --out. The
// policy file contains the command line.
void AddTrainCommand(Program& program);

// Rounds --policy to integers, plays both policies on the same starts, and writes --out. Also
// converts the files in int8 of former releases. The policy file holds the command line, the
// SHA-256 of --policy and the comparison.
void AddQuantizeCommand(Program& program);

// Plays --policy in closed loop.
void AddEvalCommand(Program& program);

// Measures --policy in the terms of NeuroBench, over episodes that it plays or that a server has
// recorded.
void AddNeuroBenchCommand(Program& program);

// Estimates the return of --policy from episodes that another version played, and says how far they
// can tell.
void AddOpeCommand(Program& program);

// Prints what the operations and the memory of --policy, in integers, and of a dense policy of the
// same sizes cost, each with its price.
void AddAccountCommand(Program& program);

// `spiketrain compare`: compares a policy with baselines that learn from the same data.
void AddCompareCommand(Program& program);

}  // namespace spikeserve
