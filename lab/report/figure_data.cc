#include "lab/report/figure_data.h"

#include <algorithm>
#include <cstdint>
#include <initializer_list>
#include <string>
#include <utility>
#include <vector>

#include "core/environment/environment.h"
#include "core/neuron/lif.h"
#include "core/neuron/phase.h"
#include "train/neuron/surrogate.h"

namespace spikeserve {
namespace {

using Json = nlohmann::ordered_json;

const ReportResult& FirstSeed(const ReportGroups& groups, const std::string& task, Mode mode) {
  return *groups.at({task, mode}).front();
}

// The unit of ImitationLoss, which depends on the task's actions.
std::string LossUnit(const std::string& task) {
  const auto environment = MakeEnvironment(task);
  if (environment.ok() && !(*environment)->action_space().is_discrete()) {
    return "mean squared error, no unit";
  }
  return "cross-entropy, nats";
}

// Empty if the runs have no held-out episodes.
Json Losses(const std::string& task, const ReportGroups& groups) {
  Json modes;
  for (const Mode mode : kReportModes) {
    for (const ReportResult* result : groups.at({task, mode})) {
      if (result->losses.empty()) continue;
      Json points = Json::array();
      for (const LossPoint& point : result->losses) points.push_back({point.iteration, point.loss});
      modes[std::string(ToString(mode))].push_back(std::move(points));
    }
  }
  if (modes.empty()) return modes;
  return {{"unit", LossUnit(task)}, {"modes", std::move(modes)}};
}

Json SpikesByStage(const std::string& task, const ReportGroups& groups) {
  Json modes;
  for (const Mode mode : kReportModes) {
    if (mode == Mode::kDense) continue;
    modes[std::string(ToString(mode))] =
        FirstSeed(groups, task, mode).evaluation.at("spikes_per_decision_by_stage");
  }
  return modes;
}

// Empty without values.
Json Histogram(const std::vector<int64_t>& values) {
  constexpr int kBins = 8;
  if (values.empty()) return {};
  const auto [least, most] = std::minmax_element(values.begin(), values.end());
  const int64_t width = (*most - *least) / kBins + 1;
  std::vector<int64_t> edges, counts(kBins);
  for (int i = 0; i <= kBins; ++i) edges.push_back(*least + i * width);
  for (const int64_t value : values) ++counts[static_cast<size_t>((value - *least) / width)];
  return {{"edges", std::move(edges)}, {"decisions", std::move(counts)}};
}

// Returns {mode: data} of the first seed, without modes that have none.
Json OfModes(const std::string& task, const ReportGroups& groups, std::initializer_list<Mode> modes,
             Json (*data_of)(const Insight&)) {
  Json result;
  for (const Mode mode : modes) {
    Json data = data_of(FirstSeed(groups, task, mode).insight);
    if (!data.empty()) result[std::string(ToString(mode))] = std::move(data);
  }
  return result;
}

Json Phases(const std::vector<const ReportResult*>& seeds) {
  Json generators;
  for (const ReportResult* result : seeds) {
    for (size_t h = 0; h < result->omega.size(); ++h) {
      generators.push_back({result->omega[h], result->phi[h]});
    }
  }
  return generators;
}

Json PhaseSpikes(const ReportResult& result) {
  const ModelConfig& config = result.run.config;
  std::vector<std::vector<double>> heads(result.omega.size());
  for (size_t h = 0; h < heads.size(); ++h) {
    for (int timestep = 0; timestep < config.context; ++timestep) {
      for (int tick = 0; tick < config.ticks; ++tick) {
        const double time = TimestepPhaseTime(timestep, tick, config.ticks);
        if (PhaseSpike(result.omega[h], result.phi[h], time)) heads[h].push_back(time);
      }
    }
  }
  if (heads.empty()) return {};
  return {{"task", result.run.environment}, {"timesteps", config.context}, {"heads", heads}};
}

Json Membrane(const ModelConfig& config) {
  constexpr int kTicks = 40;
  const Lif lif = {config.membrane_decay, config.threshold};
  Json potentials = Json::array();
  for (const double current : {0.04, 0.1, 0.3}) {
    std::vector<float> potential = {0.0f};
    float membrane = 0.0f;
    for (int tick = 1; tick <= kTicks; ++tick) {
      lif.Step(static_cast<float>(current), membrane);
      potential.push_back(membrane);
    }
    potentials.push_back({current, std::move(potential)});
  }
  return {{"threshold", config.threshold}, {"potentials", std::move(potentials)}};
}

Json Surrogates(float slope) {
  constexpr int kPoints = 40;  // on each side of the threshold
  Json curves;
  for (const auto& [kind, name] : EnumNames(SurrogateKind())) {
    Json& points = curves[std::string(name)] = Json::array();
    WithDerivative({.kind = kind, .slope = slope}, [&points](auto derivative) {
      for (int i = -kPoints; i <= kPoints; ++i) {
        const float u = static_cast<float>(i) / kPoints;
        points.push_back({u, derivative(u)});
      }
    });
  }
  return {{"slope", slope}, {"curves", std::move(curves)}};
}

}  // namespace

Json FigureData(const ReportOptions& options, const ReportGroups& groups) {
  Json figures = Json::object();
  const auto add = [&](const char* figure, const std::string& task, Json data) {
    if (!data.empty()) figures[figure][task] = std::move(data);
  };
  for (const std::string& task : options.environments) {
    add("losses", task, Losses(task, groups));
    add("spikes_by_stage", task, SpikesByStage(task, groups));
    add("spikes_per_decision", task,
        OfModes(task, groups, {Mode::kBaseline, Mode::kFull},
                [](const Insight& insight) { return Histogram(insight.spikes); }));
    add("phases", task, Phases(groups.at({task, Mode::kFull})));
    add("gates", task,
        OfModes(task, groups, {Mode::kRoute, Mode::kFull},
                [](const Insight& insight) { return Json(insight.gates); }));
  }
  Json spikes = PhaseSpikes(FirstSeed(groups, options.environments.front(), Mode::kFull));
  if (!spikes.empty()) figures["phase_spikes"] = std::move(spikes);
  figures["membrane"] = Membrane(options.config);
  figures["surrogates"] = Surrogates(options.training.surrogate.slope);
  return figures;
}

}  // namespace spikeserve
