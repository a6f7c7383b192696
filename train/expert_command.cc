#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <memory>
#include <vector>

#include "absl/strings/str_format.h"
#include "core/base/status_macros.h"
#include "nlohmann/json.hpp"
#include "train/commands.h"
#include "train/expert/expert_evaluation.h"
#include "train/record_flags.h"

namespace spikeserve {
namespace {

struct ExpertFlags {
  ExpertOptions options;
  int episodes = 100;
  uint64_t seed = 0;  // of the first episode
  bool json = false;
};

absl::Status PlayExpert(const ExpertFlags& flags) {
  const ExpertOptions& options = flags.options;
  ASSIGN_OR_RETURN(const std::unique_ptr<Expert> expert, MakeExpert(options));
  ASSIGN_OR_RETURN(const std::vector<double> returns,
                   EvaluateExpert(*expert, options.environment, flags.episodes, flags.seed));
  const auto [mean, deviation] = StatisticsOf(returns);
  const auto [least, most] = std::minmax_element(returns.begin(), returns.end());
  if (flags.json) {
    const nlohmann::ordered_json json = {{"environment", options.environment},
                                         {"mean_return", mean},
                                         {"std_return", deviation},
                                         {"min_return", *least},
                                         {"max_return", *most},
                                         {"episodes", flags.episodes},
                                         {"first_seed", flags.seed}};
    std::printf("%s\n", json.dump(2).c_str());
  } else {
    absl::PrintF("%s, %d episodes from seed %d: return %.2f ± %.2f (%.1f to %.1f)\n",
                 options.environment, flags.episodes, flags.seed, mean, deviation, *least, *most);
  }
  return absl::OkStatus();
}

}  // namespace

void AddExpertCommand(Program& program) {
  const Command command = program.root().AddCommand("expert", "Plays the expert of an environment");
  const auto flags = std::make_shared<ExpertFlags>();
  FlagGroup playing = command.Flags("Playing");
  playing.Add("env", "ID", &flags->options.environment, kEnvironmentHelp)
      .Add("episodes", "N", &flags->episodes, "Episodes to play")
      .Add("seed", "N", &flags->seed, "Seed of the first episode; each later one adds 1")
      .AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  FlagGroup expert = command.Flags("Expert");
  AddExpertFlags(expert, &flags->options);
  expert.Add("tables", "DIR", &flags->options.tables_directory,
             "Directory of the experts' value tables; default: none");
  command.SetAction([flags] { return PlayExpert(*flags); });
}

}  // namespace spikeserve
