#include "client/spikectl/run_report.h"

#include <cmath>
#include <optional>
#include <utility>

#include "absl/strings/str_format.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

constexpr double kNano = 1e9;
constexpr double kMilli = 1e3;

double PerDecision(double total, const EpisodeRecord& record) {
  return total / static_cast<double>(record.steps);
}

std::optional<double> JoulesPerDecision(EnergyModel model, const EpisodeRecord& record) {
  const std::optional<double>& total = record.joules[static_cast<size_t>(model)];
  if (!total.has_value()) return std::nullopt;
  return PerDecision(*total, record);
}

// Returns the model of the figure that people read: the first that applies.
EnergyModel ShownModel(const EpisodeRecord& record) {
  for (const auto& [model, name] : EnumNames(EnergyModel())) {
    if (JoulesPerDecision(model, record).has_value()) return model;
  }
  return kDefaultEnergyModel;
}

// Returns, for example, "7.90 nJ".
std::string EnergyText(EnergyModel model, const EpisodeRecord& record) {
  return absl::StrFormat("%.2f nJ", JoulesPerDecision(model, record).value_or(0.0) * kNano);
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

std::string RunTableHead() {
  return absl::StrFormat("%12s %10s %10s %16s %16s %11s %11s\n", "seed", "return", "decisions",
                         "spikes/decision", "energy/decision", "p50", "p99");
}

std::string RunTableLine(uint64_t seed, const EpisodeRecord& episode) {
  return absl::StrFormat(
      "%12d %10.1f %10d %16.1f %16s %8.3f ms %8.3f ms\n", seed, episode.episode_return,
      episode.steps, PerDecision(static_cast<double>(episode.spikes), episode),
      EnergyText(ShownModel(episode), episode), episode.latency.Quantile(0.5) * kMilli,
      episode.latency.Quantile(0.99) * kMilli);
}

std::string RunSummary(const std::vector<EpisodeRecord>& episodes) {
  SPIKESERVE_DCHECK(!episodes.empty());
  const EpisodeRecord sum = Sum(episodes);
  const EnergyModel shown = ShownModel(sum);
  std::string text = absl::StrFormat(
      "mean return %.1f +- %.1f over %d episodes, %d decisions\n"
      "spikes      %.1f a decision\n"
      "energy      %s a decision by the estimate %s",
      MeanReturn(episodes), ReturnDeviation(episodes), episodes.size(), sum.steps,
      PerDecision(static_cast<double>(sum.spikes), sum), EnergyText(shown, sum), ToString(shown));
  if (shown == EnergyModel::kIntSram45nm) {
    absl::StrAppendFormat(&text, ", %s without memory (%s)", EnergyText(EnergyModel::kInt45nm, sum),
                          ToString(EnergyModel::kInt45nm));
  } else {
    absl::StrAppend(&text, ", without memory");
  }
  absl::StrAppendFormat(&text,
                        "\nlatency     p50 %.3f ms, p99 %.3f ms, from the call to its answer\n",
                        sum.latency.Quantile(0.5) * kMilli, sum.latency.Quantile(0.99) * kMilli);
  return text;
}

nlohmann::ordered_json RunToJson(const std::vector<EpisodeRecord>& episodes) {
  SPIKESERVE_DCHECK(!episodes.empty());
  const EpisodeRecord sum = Sum(episodes);
  auto list = nlohmann::ordered_json::array();
  for (const EpisodeRecord& episode : episodes) {
    list.push_back(
        {{"return", episode.episode_return},
         {"steps", episode.steps},
         {"spikes_per_decision", PerDecision(static_cast<double>(episode.spikes), episode)}});
  }
  auto models = nlohmann::ordered_json::object();
  for (const auto& [model, name] : EnumNames(EnergyModel())) {
    const auto joules = JoulesPerDecision(model, sum);
    if (!joules.has_value()) continue;
    models[std::string(name)] = {{"joules_per_decision", *joules},
                                 {"leaves_out", std::string(InfoOf(model).leaves_out)}};
  }
  return {{"episodes", std::move(list)},
          {"mean_return", MeanReturn(episodes)},
          {"spikes_per_decision", PerDecision(static_cast<double>(sum.spikes), sum)},
          {"energy_joules_per_decision", JoulesPerDecision(ShownModel(sum), sum).value_or(0.0)},
          {"energy_model", std::string(ToString(ShownModel(sum)))},
          {"energy_models", std::move(models)},
          {"p50_seconds", sum.latency.Quantile(0.5)},
          {"p99_seconds", sum.latency.Quantile(0.99)}};
}

}  // namespace spikeserve
