#include "train/decided_episodes.h"

#include <utility>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/dataset/recordings.h"
#include "core/model/policy_file.h"
#include "train/evaluation/neurobench.h"
#include "train/record_flags.h"

namespace spikeserve {
namespace {
constexpr char kPlaying[] = "Playing, without --recordings";
}  // namespace

void DecidedEpisodesFlags::AddTo(const Command& command, const char* section) {
  command.Flags(section).Add("recordings", "PATH", &recordings,
                             "Episodes that a server recorded; default: play episodes");
  command.Flags(kPlaying)
      .Add("episodes", "N", &options.episodes, "Episodes to play")
      .Add("seed", "N", &options.first_seed, "Seed of the first episode; each later one adds 1");
  command.RefuseBeside("recordings", kPlaying);
}

absl::StatusOr<Evaluation> Decide(const DecidedEpisodesFlags& flags,
                                  const std::shared_ptr<const Policy>& policy) {
  if (flags.recordings.empty()) {
    absl::StatusOr<Evaluation> played = Evaluate(policy, flags.options);
    if (played.ok()) return played;
    if (absl::StartsWith(played.status().message(), "environment:")) {
      return absl::Status(played.status().code(),
                          absl::StrCat("--policy: ", played.status().message(),
                                       "; --recordings takes episodes of every environment"));
    }
    return NameFlag(played.status());
  }
  const auto recordings = ReadRecordings(flags.recordings, policy->environment);
  if (!recordings.ok()) return Annotate(recordings.status(), "--recordings");
  absl::StatusOr<Evaluation> decided = DecideAgain(policy, *recordings);
  if (!decided.ok()) return Annotate(decided.status(), "--recordings");
  return decided;
}

absl::StatusOr<std::shared_ptr<const Policy>> ReadRequiredPolicy(const std::string& path) {
  if (path.empty()) {
    return InvalidArgument("--policy", "a policy file", "none");
  }
  ASSIGN_OR_RETURN(Policy policy, ReadPolicyFile(path));
  return std::make_shared<const Policy>(std::move(policy));
}

}  // namespace spikeserve
