#include <cstdio>
#include <memory>
#include <string>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "train/commands.h"
#include "train/record_flags.h"
#include "train/train_flags.h"
#include "train/train_run.h"
#include "train/train_summary.h"

namespace spikeserve {
namespace {

constexpr char kTrainingSource[] = "Recording, without --data";

absl::Status CheckCount(absl::string_view flag, int value) {
  if (value >= 1) return absl::OkStatus();
  return InvalidArgument(absl::StrCat("--", flag), "at least 1", value);
}

absl::Status Train(const TrainFlags& flags, const std::string& command_line) {
  if (auto status = RequireOut(flags.out, "the directory to write into"); !status.ok()) {
    return status;
  }
  for (const absl::Status& status :
       {MakeTrainOptions(flags.trainer).status(), CheckCount("episodes", flags.episodes),
        CheckCount("checkpoint_every", flags.checkpoint_every),
        CheckCount("validate_every", flags.validate_every),
        CheckCount("data_memory", flags.data_memory), flags.gate.Validate()}) {
    if (!status.ok()) return status;
  }
  if (!flags.seeds.empty()) return TrainSeeds(flags, command_line);
  // Before it records data.
  RETURN_IF_ERROR(CheckOut(flags));
  ASSIGN_OR_RETURN(const EpisodeSource source, MakeSource(flags));
  ASSIGN_OR_RETURN(const TrainedPolicy trained, TrainPolicy(flags, source, command_line));
  std::fputs((flags.json ? ToJson(trained.summary, trained.policy).dump(2) + "\n"
                         : ToText(trained.summary, trained.policy))
                 .c_str(),
             stdout);
  return CheckGrade(trained.summary.verdict, flags.require);
}

void AddFlags(Command command, TrainFlags* flags) {
  command.Flags("Training")
      .Add("out", "DIR", &flags->out, "Directory of the policy and the checkpoint")
      .AddList("data", "FILE,...", &flags->data, "Datasets; default: record one")
      .Add("data_memory", "MIB", &flags->data_memory,
           "Memory for the episodes of --data; more are read in chunks")
      .Add("init", "FILE", &flags->init, "Initial policy; default: random weights")
      .Add("env", "ID", &flags->env, "Environment; default: that of --data")
      .Add("seed", "N", &flags->trainer.options.seed, "Seed of every random draw")
      .AddList("seeds", "N,...", &flags->seeds,
               "Train with each of these seeds; keep the best policy")
      .AddSwitch("resume", &flags->resume, "Continue from the checkpoint in --out, if there is one")
      .AddSwitch("overwrite", &flags->overwrite, "Replace the policy and the checkpoint in --out")
      .Add("checkpoint_every", "N", &flags->checkpoint_every, "Iterations between checkpoints")
      .Add("validate_every", "N", &flags->validate_every, "Iterations between validations")
      .Add("episodes", "N", &flags->episodes, "Episodes of the evaluation at the end")
      .Add("target_return", "RETURN", &flags->target_return,
           "Return that the policy is asked for; default: by environment or data")
      .AddSwitch("no_baselines", &flags->no_baselines,
                 "Fit no lines and perceptrons to compare the policy with")
      .Add("require", EnumKind<Grade>(), &flags->require,
           "Fail with a lower verdict; the policy is written all the same")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  FlagGroup integers = command.Flags("Integers (--arithmetic=integer with --init)");
  flags->gate.AddTo(integers);
  FlagGroup shape = command.Flags("Shape");
  AddModeFlag(shape, &flags->shape);
  AddShapeFlags(shape, &flags->shape);
  shape
      .Add("arithmetic", EnumKind<Arithmetic>(), &flags->trainer.options.arithmetic,
           "Numbers that training rounds to")
      .Add("norm", EnumKind<NormTraining>(), &flags->trainer.options.norm,
           "Norms: fade ends without any; layer keeps the policy's")
      .Add("observation_changes", "true|false", &flags->shape.observation_changes,
           "State tokens contain the change, too; default: by the data")
      .Add("lookback", "K", &flags->lookback,
           "Attention starts at the timestep K steps back; default: undirected")
      .Add("mirror", "K", &flags->mirror,
           "Attention starts mirrored at timestep K; default: undirected")
      .AddSwitch("activity_router", &flags->activity_router,
                 "The routing has one layer, which sees each head's mean")
      .AddList("image_shape", "H,W,C", &flags->image_shape, "Shape of observations that are images")
      .Add("patch_size", "N", &flags->patch_size,
           "Side in pixels of patches that share an embedding; 0: none")
      .Add("patch_features", "N", &flags->patch_features,
           "Numbers that the embedding gives a patch")
      .Add("return_offset", "RETURN", &flags->return_offset,
           "Offset of the return token; default: by environment")
      .Add("return_scale", "RETURN", &flags->return_scale,
           "Scale of the return token; default: by environment");
  AddTrainerFlags(command, &flags->trainer);
  FlagGroup recording = command.Flags(kTrainingSource);
  AddRecordFlags(recording, &flags->record);
  AddTablesFlag(recording, &flags->record.options.expert);
  command.RefuseBeside("data", kTrainingSource);
}

}  // namespace

void AddTrainCommand(Program& program) {
  const Command command = program.root().AddCommand("train", "Trains a policy");
  const auto flags = std::make_shared<TrainFlags>();
  AddFlags(command, flags.get());
  command.SetAction([flags, &program] { return Train(*flags, program.CommandLine()); });
}

}  // namespace spikeserve
