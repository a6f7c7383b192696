// The flags that say what is trained, and how.
#ifndef TRAIN_TRAIN_FLAGS_H_
#define TRAIN_TRAIN_FLAGS_H_

#include <optional>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/cli/program.h"
#include "core/model/config.h"
#include "train/trainer/trainer.h"

namespace spikeserve {

// The shape of a policy. Absent: that of --init, or of the paper.
struct ShapeFlags {
  std::optional<Mode> mode;
  std::optional<int> hidden_size;
  std::optional<int> heads;
  std::optional<int> layers;
  std::optional<int> ticks;
  std::optional<int> context;
  std::optional<int> routing_hidden_size;
  std::optional<int> ffn_size;
  std::optional<CoderKind> coder;
  std::optional<PhaseClock> phase_clock;
  std::optional<Merge> merge;
  std::optional<Gate> gate;
};

struct TrainerFlags {
  TrainOptions options;        // all but the rate targets
  double target_rate = 100.0;  // percent of ticks
  double readout_rate = 100.0;
};

// Adds --mode.
void AddModeFlag(FlagGroup& group, ShapeFlags* flags);

// Adds the other flags of the shape.
void AddShapeFlags(FlagGroup& group, ShapeFlags* flags);

// Adds the trainer's flags but --seed.
void AddTrainerFlags(Command command, TrainerFlags* flags);

// Returns the trainer's options. INVALID_ARGUMENT names the flag.
absl::StatusOr<TrainOptions> MakeTrainOptions(const TrainerFlags& flags);

// Sets in `config` what `flags` ask for. INVALID_ARGUMENT names the flag.
absl::Status SetShape(const ShapeFlags& flags, ModelConfig* config);

// INVALID_ARGUMENT names a flag that contradicts `config`, which is that of --init.
absl::Status CheckShape(const ShapeFlags& flags, const ModelConfig& config);

}  // namespace spikeserve

#endif  // TRAIN_TRAIN_FLAGS_H_
