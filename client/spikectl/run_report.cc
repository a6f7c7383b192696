#include "client/spikectl/run_report.h"

#include <cmath>

#include "absl/strings/str_format.h"

namespace spikeserve {
namespace {

constexpr double kNano = 1e9;
constexpr double kMilli = 1e3;

double PerDecision(double total, const EpisodeRecord& record) {
  return total / static_cast<double>(record.steps);
}

EpisodeRecord Sum(const std::vector<EpisodeRecord>& episodes) {
  EpisodeRecord sum;
  for (const EpisodeRecord& episode : episodes) sum += episode;
  return sum;
}

double MeanReturn(const std::vector<EpisodeRecord>& episodes) {
  return Sum(episodes).episode_return / static_cast<double>(episodes.size());
}

// Returns the population standard deviation of the returns.
double ReturnDeviation(const std::vector<EpisodeRecord>& episodes) {
  const double mean = MeanReturn(episodes);
  double squares = 0.0;
  for (const EpisodeRecord& episode : episodes) {
    squares += (episode.episode_return - mean) * (episode.episode_return - mean);
  }
  return std::sqrt(squares / static_cast<double>(episodes.size()));
}

}  // namespace

std::string RunTableHead(const std::string& energy_model) {
  return absl::StrFormat(
             "energy per decision is an estimate, energy model %s; latency as the client sees "
             "Act\n",
             energy_model) +
         absl::StrFormat("%12s %10s %10s %16s %18s %10s %10s\n", "seed", "return", "decisions",
                         "spikes/decision", "energy/decision", "p50", "p99");
}

std::string RunTableLine(uint64_t seed, const EpisodeRecord& episode) {
  return absl::StrFormat(
      "%12d %10.1f %10d %16.1f %15.3f nJ %7.3f ms %7.3f ms\n", seed, episode.episode_return,
      episode.steps, PerDecision(static_cast<double>(episode.spikes), episode),
      PerDecision(episode.energy_joules, episode) * kNano, episode.latency.Quantile(0.5) * kMilli,
      episode.latency.Quantile(0.99) * kMilli);
}

std::string RunSummary(const std::vector<EpisodeRecord>& episodes,
                       const std::string& energy_model) {
  const EpisodeRecord sum = Sum(episodes);
  return absl::StrFormat("mean return %.1f +- %.1f over %d episodes, %d decisions\n",
                         MeanReturn(episodes), ReturnDeviation(episodes), episodes.size(),
                         sum.steps) +
         absl::StrFormat("%.1f spikes per decision; estimated energy per decision: %.3f nJ by %s",
                         PerDecision(static_cast<double>(sum.spikes), sum),
                         PerDecision(sum.energy_joules, sum) * kNano, energy_model) +
         (energy_model == "horowitz_45nm"
              ? "\n"
              : absl::StrFormat(", %.3f nJ by horowitz_45nm\n",
                                PerDecision(sum.horowitz_energy_joules, sum) * kNano)) +
         absl::StrFormat("latency p50 %.3f ms, p99 %.3f ms\n", sum.latency.Quantile(0.5) * kMilli,
                         sum.latency.Quantile(0.99) * kMilli);
}

nlohmann::ordered_json RunToJson(const std::vector<EpisodeRecord>& episodes) {
  const EpisodeRecord sum = Sum(episodes);
  auto list = nlohmann::ordered_json::array();
  for (const EpisodeRecord& episode : episodes) {
    list.push_back(
        {{"return", episode.episode_return},
         {"steps", episode.steps},
         {"spikes_per_decision", PerDecision(static_cast<double>(episode.spikes), episode)}});
  }
  return {{"episodes", std::move(list)},
          {"mean_return", MeanReturn(episodes)},
          {"spikes_per_decision", PerDecision(static_cast<double>(sum.spikes), sum)},
          {"energy_joules_per_decision", PerDecision(sum.energy_joules, sum)},
          {"p50_seconds", sum.latency.Quantile(0.5)},
          {"p99_seconds", sum.latency.Quantile(0.99)}};
}

}  // namespace spikeserve
