#include "train/expert/expert_evaluation.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <memory>
#include <thread>

#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "core/environment/environment.h"
#include "core/math/vector_view.h"

namespace spikeserve {
namespace {

double PlayEpisode(Environment& environment, uint64_t seed, Expert& expert) {
  environment.Reset(seed);
  expert.BeginEpisode(seed);
  double episode_return = 0.0;
  for (StepResult result; !result.done(); episode_return += result.reward) {
    result = environment.Step(expert.Act(environment.state()));
  }
  return episode_return;
}

}  // namespace

absl::StatusOr<std::vector<double>> EvaluateExpert(const Expert& expert,
                                                   const std::string& environment, int episodes,
                                                   uint64_t first_seed) {
  if (episodes < 1) {
    return InvalidArgument("episodes", "at least 1", episodes);
  }
  RETURN_IF_ERROR(MakeEnvironment(environment).status());
  std::vector<double> returns(episodes);
  std::atomic<int> next = 0;
  const auto play = [&] {
    const std::unique_ptr<Environment> task = *MakeEnvironment(environment);
    const std::unique_ptr<Expert> player = expert.Clone();
    for (int i = next++; i < episodes; i = next++) {
      returns[i] = PlayEpisode(*task, first_seed + static_cast<uint64_t>(i), *player);
    }
  };
  std::vector<std::thread> threads(std::max(1u, std::thread::hardware_concurrency()));
  for (std::thread& thread : threads) thread = std::thread(play);
  for (std::thread& thread : threads) thread.join();
  return returns;
}

ReturnSummary StatisticsOf(absl::Span<const double> returns) {
  SPIKESERVE_DCHECK(!returns.empty());
  const double mean = AsVector(returns).mean();
  return {.mean = mean, .std = std::sqrt((AsVector(returns).array() - mean).square().mean())};
}

}  // namespace spikeserve
