// The flags for the shape of a policy and for its training.
#pragma once

#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/cli/program.h"
#include "core/model/config.h"
#include "train/trainer/trainer.h"

namespace spikeserve {

// The shape of a policy. An absent value is that of the policy of --init, or else of the paper.
struct ShapeFlags {
  std::optional<Mode> mode;
  std::optional<int> hidden_size;
  std::optional<int> heads;
  std::optional<int> layers;
  std::optional<int> ticks;
  std::optional<int> context;
  std::optional<int> routing_hidden_size;
  std::optional<int> ffn_size;
  std::optional<PhaseClock> phase_clock;
  std::optional<Merge> merge;
  std::optional<Gate> gate;
  std::optional<bool> observation_changes;
};

struct TrainerFlags {
  TrainOptions options;  // without the targets of the firing rates
  std::string device = "cpu";
  double target_rate = 100.0;  // percent of the ticks
  double readout_rate = 100.0;
  std::string delay = "0";  // steps, "3" or "0..5"
};

// Adds --mode.
void AddModeFlag(FlagGroup& group, ShapeFlags* flags);

// Adds the other flags of the shape.
void AddShapeFlags(FlagGroup& group, ShapeFlags* flags);

// Adds the flags of the trainer except --seed.
void AddTrainerFlags(Command command, TrainerFlags* flags);

// Returns the options of the trainer, or INVALID_ARGUMENT, which names the flag.
absl::StatusOr<TrainOptions> MakeTrainOptions(const TrainerFlags& flags);

// Sets the fields of `config` for which a flag is set. Returns INVALID_ARGUMENT, which names the
// flag, if a value is invalid.
absl::Status SetShape(const ShapeFlags& flags, ModelConfig* config);

// Sets the ticks of `config`, the configuration of the policy of --init: no tensor depends on them,
// and training with ever fewer ticks can end at a single one (Chowdhury, Rathi and Roy, "One
// timestep is all you need", 2021). Returns INVALID_ARGUMENT, which names the flag, if another flag
// contradicts `config`, or a value is invalid.
absl::Status ContinueShape(const ShapeFlags& flags, ModelConfig* config);

}  // namespace spikeserve
