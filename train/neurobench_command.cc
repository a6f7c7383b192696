#include <cstdio>
#include <memory>
#include <string>

#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "train/commands.h"
#include "train/decided_episodes.h"
#include "train/evaluation/neurobench.h"

namespace spikeserve {
namespace {

struct NeuroBenchFlags {
  std::string policy;
  DecidedEpisodesFlags episodes;
  bool json = false;
};

absl::Status Measure(const NeuroBenchFlags& flags) {
  ASSIGN_OR_RETURN(const auto policy, ReadRequiredPolicy(flags.policy));
  ASSIGN_OR_RETURN(const Evaluation evaluation, Decide(flags.episodes, policy));
  const absl::StatusOr<NeuroBench> metrics = MeasureNeuroBench(*policy, evaluation);
  if (!metrics.ok()) return Annotate(metrics.status(), "--policy");
  std::fputs((flags.json ? ToJson(*metrics).dump(2) + "\n" : ToText(*metrics)).c_str(), stdout);
  return absl::OkStatus();
}

}  // namespace

void AddNeuroBenchCommand(Program& program) {
  const Command command =
      program.root().AddCommand("neurobench", "Measures a policy in the terms of NeuroBench");
  const auto flags = std::make_shared<NeuroBenchFlags>();
  constexpr char kPolicy[] = "Policy";
  command.Flags(kPolicy).Add("policy", "FILE", &flags->policy, "Policy file");
  flags->episodes.AddTo(command, kPolicy);
  command.Flags(kPolicy).AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  command.SetAction([flags] { return Measure(*flags); });
}

}  // namespace spikeserve
