#include <algorithm>
#include <cstdio>

#include "absl/flags/flag.h"
#include "absl/strings/str_format.h"
#include "nlohmann/json.hpp"
#include "train/commands.h"
#include "train/common_flags.h"
#include "train/expert/expert_evaluation.h"

namespace spikeserve {

absl::Status ExpertCommand() {
  const ExpertOptions options = ExpertOptionsFromFlags();
  const int episodes = absl::GetFlag(FLAGS_episodes);
  const uint64_t first_seed = absl::GetFlag(FLAGS_seed).value_or(0);
  const absl::StatusOr<std::unique_ptr<Expert>> expert = MakeExpert(options);
  if (!expert.ok()) return expert.status();
  const absl::StatusOr<std::vector<double>> returns =
      EvaluateExpert(**expert, options.environment, episodes, first_seed);
  if (!returns.ok()) return returns.status();
  const auto [mean, deviation] = StatisticsOf(*returns);
  const auto [least, most] = std::minmax_element(returns->begin(), returns->end());
  if (absl::GetFlag(FLAGS_json)) {
    const nlohmann::ordered_json json = {{"environment", options.environment},
                                         {"mean_return", mean},
                                         {"std_return", deviation},
                                         {"min_return", *least},
                                         {"max_return", *most},
                                         {"episodes", episodes},
                                         {"first_seed", first_seed}};
    std::printf("%s\n", json.dump(2).c_str());
  } else {
    absl::PrintF("%s, %d episodes from seed %d: return %.2f ± %.2f (%.1f to %.1f)\n",
                 options.environment, episodes, first_seed, mean, deviation, *least, *most);
  }
  return absl::OkStatus();
}

}  // namespace spikeserve
