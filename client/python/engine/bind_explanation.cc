#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "client/python/engine/bindings.h"
#include "client/python/engine/convert.h"
#include "core/engine/trace.h"

namespace spikeserve {
namespace {

namespace nb = nanobind;

struct BoundToken {
  std::string kind;
  int64_t timestep = 0;
};

struct BoundRaster {
  std::string stage;
  std::optional<int> layer;
  BoundToken token;
  int population = 0;
  std::vector<int> ticks = {};
  std::vector<int> neurons = {};
};

// Weights of shape [rows, columns, depth].
struct BoundWeights {
  int layer = 0;
  std::vector<BoundToken> tokens;
  std::vector<float> weights;
  size_t rows = 0;
  size_t columns = 0;
  size_t depth = 0;
};

struct BoundAttention : BoundWeights {};
struct BoundGates : BoundWeights {};

struct BoundExplanation {
  std::string mode;
  int layers = 0;
  int heads = 0;
  int ticks = 0;
  int64_t episode = 0;
  std::vector<float> observation;
  BoundDecision decision;
  std::vector<float> readout;
  std::vector<BoundRaster> rasters = {};
  std::vector<BoundAttention> attention = {};
  std::vector<BoundGates> routing = {};
};

BoundToken ToBound(const TokenName& name) {
  switch (name.kind) {
    case TokenKind::kReturn:
      return {"return_to_go", name.timestep};
    case TokenKind::kState:
      return {"state", name.timestep};
    case TokenKind::kAction:
      return {"action", name.timestep};
  }
  return {};
}

std::vector<BoundToken> ToBound(const std::vector<TokenName>& names) {
  std::vector<BoundToken> tokens;
  for (const TokenName& name : names) tokens.push_back(ToBound(name));
  return tokens;
}

BoundRaster ToBound(const PopulationTrace& population) {
  BoundRaster raster = {.stage = std::string(ToString(population.stage)),
                        .layer = std::nullopt,
                        .token = ToBound(population.token),
                        .population = static_cast<int>(population.spikes[0].size())};
  if (population.layer != kNoLayer) raster.layer = population.layer;
  for (size_t tick = 0; tick < population.spikes.size(); ++tick) {
    for (size_t neuron = 0; neuron < population.spikes[tick].size(); ++neuron) {
      if (population.spikes[tick][neuron] == 0) continue;
      raster.ticks.push_back(static_cast<int>(tick));
      raster.neurons.push_back(static_cast<int>(neuron));
    }
  }
  return raster;
}

void AddLayer(const LayerTrace& trace, int layer, BoundExplanation* bound) {
  const auto ticks = static_cast<size_t>(bound->ticks);
  const auto heads = static_cast<size_t>(bound->heads);
  bound->attention.push_back(
      {{layer, ToBound(trace.keys), trace.attention, ticks, heads, trace.keys.size()}});
  if (trace.gated.empty()) return;
  bound->routing.push_back(
      {{layer, ToBound(trace.gated), trace.gates, trace.gated.size(), ticks, heads}});
}

nb::object WeightsOf(const BoundWeights& bound) {
  return ToNumpy(bound.weights, {bound.rows, bound.columns, bound.depth});
}

void BindParts(nb::module_& module) {
  nb::class_<BoundToken>(module, "Token", "One token of the model's input.")
      .def_ro("kind", &BoundToken::kind, "return_to_go, state or action.")
      .def_ro("timestep", &BoundToken::timestep)
      .def("__repr__", [](const BoundToken& token) {
        return "Token('" + token.kind + "', " + std::to_string(token.timestep) + ")";
      });
  nb::class_<BoundRaster>(module, "SpikeRaster",
                          "The spikes of one population for one token: ticks[i], neurons[i].")
      .def_ro("stage", &BoundRaster::stage)
      .def_ro("layer", &BoundRaster::layer, "None for phase and readout.")
      .def_ro("token", &BoundRaster::token)
      .def_ro("population", &BoundRaster::population)
      .def_prop_ro("ticks", [](const BoundRaster& raster) { return ToNumpy(raster.ticks); })
      .def_prop_ro("neurons", [](const BoundRaster& raster) { return ToNumpy(raster.neurons); });
  nb::class_<BoundAttention>(module, "Attention",
                             "Attention weights of the decision's state token in one layer.")
      .def_prop_ro("layer", [](const BoundAttention& a) { return a.layer; })
      .def_prop_ro("keys", [](const BoundAttention& a) { return a.tokens; })
      .def_prop_ro(
          "weights", [](const BoundAttention& a) { return WeightsOf(a); },
          "float32 [ticks, heads, keys].");
  nb::class_<BoundGates>(module, "RoutingGates", "Routing gates of one layer.")
      .def_prop_ro("layer", [](const BoundGates& g) { return g.layer; })
      .def_prop_ro("tokens", [](const BoundGates& g) { return g.tokens; })
      .def_prop_ro(
          "gates", [](const BoundGates& g) { return WeightsOf(g); },
          "float32 [tokens, ticks, heads].");
}

}  // namespace

void BindExplanation(nb::module_& module) {
  BindParts(module);
  nb::class_<BoundExplanation>(module, "Explanation", "The inside of the last decision.")
      .def_ro("mode", &BoundExplanation::mode)
      .def_ro("layers", &BoundExplanation::layers)
      .def_ro("heads", &BoundExplanation::heads)
      .def_ro("ticks", &BoundExplanation::ticks)
      .def_ro("episode", &BoundExplanation::episode)
      .def_prop_ro("observation", [](const BoundExplanation& e) { return ToNumpy(e.observation); })
      .def_ro("decision", &BoundExplanation::decision)
      .def_prop_ro(
          "logits", [](const BoundExplanation& e) { return ToNumpy(e.decision.answer.logits); },
          "Of the head that made the decision. A session that learns may have another head now.")
      .def_prop_ro("readout", [](const BoundExplanation& e) { return ToNumpy(e.readout); })
      .def_ro("rasters", &BoundExplanation::rasters)
      .def_ro("attention", &BoundExplanation::attention)
      .def_ro("routing", &BoundExplanation::routing);
}

nb::object ToPython(LocalSession::Explained explained, const Policy& policy) {
  const ModelConfig& config = policy.config;
  const Session& session = explained.session;
  const auto observation = session.history.observation(session.history.size() - 1);
  BoundExplanation bound = {.mode = std::string(ToString(config.mode)),
                            .layers = config.layers,
                            .heads = config.heads,
                            .ticks = config.is_dense() ? 1 : config.ticks,
                            .episode = session.episode,
                            .observation = {observation.begin(), observation.end()},
                            .decision = ToBound(*session.last_answer, policy),
                            .readout = std::move(explained.explanation.readout)};
  const Trace& trace = explained.explanation.trace;
  for (const PopulationTrace& population : trace.populations) {
    bound.rasters.push_back(ToBound(population));
  }
  for (size_t i = 0; i < trace.layers.size(); ++i) {
    AddLayer(trace.layers[i], static_cast<int>(i), &bound);
  }
  return nb::cast(std::move(bound));
}

}  // namespace spikeserve
