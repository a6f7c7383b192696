#include <cstdio>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/dataset/recordings.h"
#include "core/model/policy_file.h"
#include "train/commands.h"
#include "train/evaluation/evaluation.h"
#include "train/evaluation/neurobench.h"
#include "train/record_flags.h"

namespace spikeserve {
namespace {

constexpr char kPlaying[] = "Playing, without --recordings";

struct NeuroBenchFlags {
  std::string policy;
  std::string recordings;  // empty: the policy plays
  EvaluationOptions options;
  bool json = false;
};

absl::StatusOr<Evaluation> Decide(const NeuroBenchFlags& flags,
                                  const std::shared_ptr<const Policy>& policy) {
  if (flags.recordings.empty()) {
    absl::StatusOr<Evaluation> played = Evaluate(policy, flags.options);
    if (!played.ok()) return NameFlag(played.status());
    return played;
  }
  const auto recordings = ReadRecordings(flags.recordings, policy->environment);
  if (!recordings.ok()) return Annotate(recordings.status(), "--recordings");
  absl::StatusOr<Evaluation> decided = DecideAgain(policy, *recordings);
  if (!decided.ok()) return Annotate(decided.status(), "--recordings");
  return decided;
}

absl::Status Measure(const NeuroBenchFlags& flags) {
  if (flags.policy.empty()) {
    return absl::InvalidArgumentError("--policy: expected a policy file, received none");
  }
  absl::StatusOr<Policy> read = ReadPolicyFile(flags.policy);
  if (!read.ok()) return read.status();
  const auto policy = std::make_shared<const Policy>(*std::move(read));
  const absl::StatusOr<Evaluation> evaluation = Decide(flags, policy);
  if (!evaluation.ok()) return evaluation.status();
  const absl::StatusOr<NeuroBench> metrics = MeasureNeuroBench(*policy, *evaluation);
  if (!metrics.ok()) return Annotate(metrics.status(), "--policy");
  std::fputs((flags.json ? ToJson(*metrics).dump(2) + "\n" : ToText(*metrics)).c_str(), stdout);
  return absl::OkStatus();
}

}  // namespace

void AddNeuroBenchCommand(Program& program) {
  const Command command =
      program.root().AddCommand("neurobench", "Measures a policy in the terms of NeuroBench");
  const auto flags = std::make_shared<NeuroBenchFlags>();
  command.Flags("Policy")
      .Add("policy", "FILE", &flags->policy, "Policy file")
      .Add("recordings", "PATH", &flags->recordings,
           "Episodes that a server recorded; default: play episodes")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  command.Flags(kPlaying)
      .Add("episodes", "N", &flags->options.episodes, "Episodes to play")
      .Add("seed", "N", &flags->options.first_seed,
           "Seed of the first episode; each later one adds 1");
  command.RefuseBeside("recordings", kPlaying);
  command.SetAction([flags] { return Measure(*flags); });
}

}  // namespace spikeserve
