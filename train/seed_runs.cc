#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/environment/environment.h"
#include "train/train_run.h"

namespace spikeserve {
namespace {

struct SeedRun {
  uint64_t seed;
  TrainedPolicy trained;

  double mean_return() const { return trained.summary.evaluation->mean_return(); }
  double spikes() const { return trained.summary.evaluation->spikes_per_decision(); }
};

// The outcome of all runs.
struct SeedSummary {
  double mean;    // of the returns of the policies
  double spread;  // their standard deviation, with the divisor n - 1; 0 for one policy
  size_t best;    // index of the run with the highest return; the first of equal ones
};

SeedSummary Summarise(const std::vector<SeedRun>& runs) {
  const auto count = static_cast<double>(runs.size());
  SeedSummary summary = {.mean = 0.0, .spread = 0.0, .best = 0};
  for (size_t i = 0; i < runs.size(); ++i) {
    summary.mean += runs[i].mean_return() / count;
    if (runs[i].mean_return() > runs[summary.best].mean_return()) summary.best = i;
  }
  double squares = 0.0;
  for (const SeedRun& run : runs) squares += std::pow(run.mean_return() - summary.mean, 2);
  summary.spread = std::sqrt(squares / std::max(1.0, count - 1.0));
  return summary;
}

absl::StatusOr<std::vector<uint64_t>> ParseSeeds(const TrainFlags& flags) {
  if (flags.trainer.options.seed != 0) {
    return InvalidArgument("--seed", "no such flag beside --seeds", flags.trainer.options.seed);
  }
  std::vector<uint64_t> seeds;
  for (const std::string& text : flags.seeds) {
    uint64_t seed = 0;
    if (!absl::SimpleAtoi(text, &seed) ||
        std::find(seeds.begin(), seeds.end(), seed) != seeds.end()) {
      return InvalidArgument("--seeds", "different integers of at least 0", text);
    }
    seeds.push_back(seed);
  }
  return seeds;
}

// Returns the flags of the training with one of the seeds.
TrainFlags FlagsOf(const TrainFlags& flags, uint64_t seed) {
  TrainFlags own = flags;
  own.trainer.options.seed = seed;
  own.gate.allow_loss = true;  // the best one is checked
  own.out = absl::StrCat(flags.out, "/seed-", seed);
  return own;
}

// Does what CheckOut() does for the directory of every seed, and for the policy in --out, which
// --resume replaces only if one of these seeds has a checkpoint to continue from.
absl::Status CheckOuts(const TrainFlags& flags, const std::vector<uint64_t>& seeds) {
  bool continues = false;
  for (const uint64_t seed : seeds) {
    const TrainFlags own = FlagsOf(flags, seed);
    RETURN_IF_ERROR(CheckOut(own));
    continues |= flags.resume && std::filesystem::exists(own.out + "/checkpoint.pt");
  }
  if (continues) return absl::OkStatus();
  TrainFlags whole = flags;
  whole.resume = false;  // a checkpoint beside the policy is that of another run
  return CheckOut(whole);
}

absl::Status CheckPlayable(const std::string& environment) {
  if (MakeEnvironment(environment).ok()) return absl::OkStatus();
  return InvalidArgument(
      "--seeds", "an environment that spiketrain plays",
      absl::StrCat(environment,
                   "; `python -m spikeserve imitate --seeds` plays those of Gymnasium"));
}

nlohmann::ordered_json ToJson(const std::vector<SeedRun>& runs, const SeedSummary& summary) {
  nlohmann::ordered_json json = {{"seeds", nlohmann::ordered_json::array()},
                                 {"mean_over_seeds", summary.mean},
                                 {"std_over_seeds", summary.spread},
                                 {"best_seed", runs[summary.best].seed}};
  for (const SeedRun& run : runs) {
    json["seeds"].push_back({{"seed", run.seed},
                             {"mean_return", run.mean_return()},
                             {"spikes_per_decision", run.spikes()},
                             {"policy_file", run.trained.summary.path}});
  }
  return json;
}

std::string ToText(const std::vector<SeedRun>& runs, const SeedSummary& summary) {
  std::string text;
  for (const SeedRun& run : runs) {
    absl::StrAppendFormat(&text, "seed %d: return %.2f, %.1f spikes per decision\n", run.seed,
                          run.mean_return(), run.spikes());
  }
  absl::StrAppendFormat(&text, "%d seeds: mean return %.2f, standard deviation %.2f; best: %d\n",
                        runs.size(), summary.mean, summary.spread, runs[summary.best].seed);
  return text;
}

// Copies the best policy to --out and prints the summary of all.
absl::Status Finish(const TrainFlags& flags, std::vector<SeedRun> runs) {
  const SeedSummary summary = Summarise(runs);
  TrainedPolicy& best = runs[summary.best].trained;
  const std::string path = absl::StrCat(flags.out, "/policy.safetensors");
  if (const auto& loss = best.summary.loss; loss.has_value()) {
    RETURN_IF_ERROR(flags.gate.Check(*loss, kLossAdvice));
  }
  ASSIGN_OR_RETURN(const std::string bytes, ReadFile(best.summary.path));
  RETURN_IF_ERROR(WriteFileAtomically(path, {bytes}));
  const nlohmann::ordered_json all = ToJson(runs, summary);
  best.summary.path = path;
  if (flags.json) {
    nlohmann::ordered_json json = ToJson(best.summary, best.policy);
    json.update(all);
    std::fputs((json.dump(2) + "\n").c_str(), stdout);
  } else {
    std::fputs((ToText(runs, summary) + ToText(best.summary, best.policy)).c_str(), stdout);
  }
  return CheckGrade(best.summary.verdict, flags.require);
}

}  // namespace

absl::Status TrainSeeds(const TrainFlags& flags, const std::string& command_line) {
  ASSIGN_OR_RETURN(const std::vector<uint64_t> seeds, ParseSeeds(flags));
  // Before it records data or trains.
  RETURN_IF_ERROR(CheckOuts(flags, seeds));
  std::optional<EpisodeSource> source;
  std::vector<SeedRun> runs;
  for (const uint64_t seed : seeds) {
    const TrainFlags own = FlagsOf(flags, seed);
    // Without --data, every seed records its own.
    if (!source.has_value() || flags.data.empty()) {
      ASSIGN_OR_RETURN(EpisodeSource made, MakeSource(own));
      source.emplace(std::move(made));
      RETURN_IF_ERROR(CheckPlayable(source->dataset().environment));
    }
    ASSIGN_OR_RETURN(TrainedPolicy trained, TrainPolicy(own, *source, command_line));
    runs.push_back({.seed = seed, .trained = std::move(trained)});
  }
  return Finish(flags, std::move(runs));
}

}  // namespace spikeserve
