#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <cstdint>
#include <optional>
#include <string>
#include <utility>

#include "client/python/engine/bindings.h"
#include "client/python/engine/convert.h"
#include "core/engine/energy.h"
#include "core/learning/frobenius_norm.h"

namespace spikeserve {
namespace {

namespace nb = nanobind;
using nb::literals::operator""_a;

struct DiscreteSpace {
  int n = 0;
};

struct BoxSpace {
  std::vector<float> low;
  std::vector<float> high;
};

// The cost of a decision.
struct BoundStats {
  Counts counts;
  double compute_seconds = 0.0;
  ModelConfig config;
};

struct BoundState {
  int64_t episode = 0;
  int64_t step = 0;
  double episode_return = 0.0;
  double return_to_go = 0.0;
  double target_return = 0.0;
  double trace_norm = 0.0;
  double head_drift = 0.0;
  double modulator_mean = 0.0;
  double modulator_std = 0.0;
  int64_t rollbacks = 0;
  uint64_t spikes = 0;
  double energy_joules = 0.0;
  uint64_t decisions = 0;
  std::vector<float> head_delta = {};
};

nb::object ActionOf(const Answer& answer, bool discrete) {
  return discrete ? nb::cast(answer.action.discrete) : ToNumpy(answer.action.continuous);
}

template <EnergyModel model>
std::optional<double> Joules(const BoundStats& stats) {
  return EstimateEnergy(model, stats.counts, stats.config);
}

nb::dict SpikesByStage(const BoundStats& stats) {
  nb::dict spikes;
  for (const auto& [stage, name] : EnumNames(Stage())) {
    spikes[nb::str(name.data(), name.size())] = stats.counts.spikes(stage);
  }
  return spikes;
}

void BindSpaces(nb::module_& module) {
  nb::class_<DiscreteSpace>(module, "Discrete", "Indices from 0 to n - 1.")
      .def_ro("n", &DiscreteSpace::n)
      .def_prop_ro("start", [](const DiscreteSpace&) { return 0; })
      .def("__repr__",
           [](const DiscreteSpace& space) { return "Discrete(" + std::to_string(space.n) + ")"; });
  nb::class_<BoxSpace>(module, "Box", "Vectors within finite bounds, in environment units.")
      .def_prop_ro("low", [](const BoxSpace& space) { return ToNumpy(space.low); })
      .def_prop_ro("high", [](const BoxSpace& space) { return ToNumpy(space.high); });
}

void BindStats(nb::module_& module) {
  nb::class_<BoundStats>(module, "Stats", "The cost of one decision. Energies are estimates.")
      .def_prop_ro("spikes", [](const BoundStats& s) { return s.counts.total_spikes(); })
      .def_prop_ro("synaptic_operations",
                   [](const BoundStats& s) { return s.counts.synaptic_operations(); })
      .def_prop_ro("energy_joules",
                   [](const BoundStats& s) { return DefaultEnergy(s.counts, s.config); })
      .def_ro("compute_seconds", &BoundStats::compute_seconds)
      .def_prop_ro("spikes_by_stage", &SpikesByStage)
      .def_prop_ro("accumulates", [](const BoundStats& s) { return s.counts.accumulates; })
      .def_prop_ro("multiply_accumulates",
                   [](const BoundStats& s) { return s.counts.multiply_accumulates; })
      .def_prop_ro("attention_products",
                   [](const BoundStats& s) { return s.counts.attention_products; })
      .def_prop_ro("horowitz_energy_joules",
                   [](const BoundStats& s) { return DefaultEnergy(s.counts, s.config); })
      .def_prop_ro("membrane_updates",
                   [](const BoundStats& s) { return s.counts.membrane_updates; })
      .def_prop_ro("coder_gains", [](const BoundStats& s) { return s.counts.coder_gains; })
      .def_prop_ro("layer_norm_elements",
                   [](const BoundStats& s) { return s.counts.layer_norm_elements; })
      .def_prop_ro("softmax_terms", [](const BoundStats& s) { return s.counts.softmax_terms; })
      .def_prop_ro("gate_products", [](const BoundStats& s) { return s.counts.gate_products; })
      .def_prop_ro("integer_multiply_accumulates",
                   [](const BoundStats& s) { return s.counts.integer_multiply_accumulates; })
      .def_prop_ro("spike_energy_joules", &Joules<EnergyModel::kSpike5pj>,
                   "None for a dense policy.")
      .def_prop_ro("int_energy_joules", &Joules<EnergyModel::kInt45nm>,
                   "None for a policy in float32.")
      .def_prop_ro("int_sram_energy_joules", &Joules<EnergyModel::kIntSram45nm>,
                   "None for a policy in float32.");
}

void BindDecision(nb::module_& module) {
  nb::class_<BoundDecision>(module, "Decision", "The answer to one observation.")
      .def_prop_ro("step", [](const BoundDecision& d) { return d.answer.step; })
      .def_prop_ro(
          "action", [](const BoundDecision& d) { return ActionOf(d.answer, d.discrete); },
          "An int for a Discrete space, a float32 array for a Box.")
      .def_prop_ro(
          "action_probabilities",
          [](const BoundDecision& d) -> nb::object {
            return d.discrete ? ToNumpy(d.answer.probabilities) : nb::none();
          },
          "float32 [n]; None for a Box.")
      .def_prop_ro("logits", [](const BoundDecision& d) { return ToNumpy(d.answer.logits); })
      .def_prop_ro("return_to_go", [](const BoundDecision& d) { return d.answer.return_to_go; })
      .def_prop_ro("stats", [](const BoundDecision& d) {
        return BoundStats{d.answer.counts, d.answer.compute_seconds, d.config};
      });
}

// Returns one number per decision of a batch.
template <typename Number, typename Get>
nb::object Column(const BoundBatch& batch, Get get) {
  std::vector<Number> column;
  column.reserve(batch.answers.rows().size());
  for (const BatchAnswers::Row& row : batch.answers.rows()) column.push_back(get(row));
  return ToNumpy(std::move(column));
}

// Returns `values` as one row per decision of a batch.
nb::object Rows(const BoundBatch& batch, const std::vector<float>& values) {
  const size_t count = batch.answers.rows().size();
  const size_t width = count == 0 ? 0 : values.size() / count;
  return ToNumpy(values, {count, width});
}

void BindBatch(nb::module_& module) {
  nb::class_<BoundBatch>(module, "Batch", "The decisions of one act_batch, in the order of rows.")
      .def_prop_ro(
          "actions",
          [](const BoundBatch& batch) -> nb::object {
            if (!batch.discrete) return Rows(batch, batch.answers.continuous());
            return Column<int64_t>(batch, [](const auto& row) { return row.discrete; });
          },
          "int64 [rows] for a Discrete space, float32 [rows, n] for a Box.")
      .def_prop_ro(
          "action_probabilities",
          [](const BoundBatch& batch) -> nb::object {
            if (!batch.discrete) return nb::none();
            return Rows(batch, batch.answers.probabilities());
          },
          "float32 [rows, n]; None for a Box.")
      .def_prop_ro("returns_to_go",
                   [](const BoundBatch& batch) {
                     return Column<float>(batch, [](const auto& row) { return row.return_to_go; });
                   })
      .def_prop_ro("spikes",
                   [](const BoundBatch& batch) {
                     return Column<uint64_t>(
                         batch, [](const auto& row) { return row.counts.total_spikes(); });
                   })
      .def("__len__", [](const BoundBatch& batch) { return batch.answers.rows().size(); })
      .def("__getitem__", [](const BoundBatch& batch, int64_t row) {
        const auto size = static_cast<int64_t>(batch.answers.rows().size());
        const int64_t index = row < 0 ? row + size : row;
        if (index < 0 || index >= size) throw nb::index_error("row: expected a row of the batch");
        return BoundDecision{batch.answers.At(static_cast<size_t>(index)), batch.discrete,
                             batch.config};
      });
}

void BindSummaries(nb::module_& module) {
  nb::class_<LearningSummary>(module, "LearningSummary", "What a session learned in an episode.")
      .def_ro("updates", &LearningSummary::updates)
      .def_ro("rejected_updates", &LearningSummary::rejected)
      .def_ro("head_drift", &LearningSummary::head_drift)
      .def_prop_ro("modulator_mean", [](const LearningSummary& s) { return s.returns.mean; })
      .def_prop_ro("modulator_std", [](const LearningSummary& s) { return s.returns.deviation(); })
      .def_ro("rolled_back", &LearningSummary::rolled_back)
      .def_ro("watched_return", &LearningSummary::watched_return);
  nb::class_<EpisodeSummary>(module, "EpisodeSummary", "The totals of an episode that has ended.")
      .def_ro("episode_return", &EpisodeSummary::episode_return)
      .def_ro("steps", &EpisodeSummary::steps)
      .def_ro("spikes", &EpisodeSummary::spikes)
      .def_ro("energy_joules", &EpisodeSummary::energy_joules)
      .def_ro("learning", &EpisodeSummary::learning, "None for a session that does not learn.");
}

void BindState(nb::module_& module) {
  nb::class_<BoundState>(module, "SessionState", "The state of a session.")
      .def_ro("episode", &BoundState::episode)
      .def_ro("step", &BoundState::step)
      .def_ro("episode_return", &BoundState::episode_return)
      .def_ro("return_to_go", &BoundState::return_to_go)
      .def_ro("target_return", &BoundState::target_return)
      .def_ro("trace_norm", &BoundState::trace_norm)
      .def_ro("head_drift", &BoundState::head_drift)
      .def_ro("modulator_mean", &BoundState::modulator_mean)
      .def_ro("modulator_std", &BoundState::modulator_std)
      .def_ro("rollbacks", &BoundState::rollbacks)
      .def_ro("spikes", &BoundState::spikes)
      .def_ro("energy_joules", &BoundState::energy_joules)
      .def_ro("decisions", &BoundState::decisions)
      .def_prop_ro(
          "head_delta", [](const BoundState& state) { return ToNumpy(state.head_delta); },
          "float32 [outputs * hidden size]: W - W_base of the head; empty for the policy's head.");
}

BoundState ReadState(const AgentSession& agent) {
  const Session& session = agent.session();
  const Eigen::VectorXf delta = agent.HeadDelta();
  BoundState state = {.episode = session.episode,
                      .step = session.step,
                      .episode_return = session.episode_return,
                      .return_to_go = session.return_to_go,
                      .target_return = session.target_return,
                      .head_drift = agent.HeadDrift(),
                      .spikes = session.spikes,
                      .energy_joules = session.energy_joules,
                      .decisions = session.decisions,
                      .head_delta = {delta.begin(), delta.end()}};
  if (!session.learner.has_value()) return state;
  state.trace_norm = FrobeniusNorm(session.learner->trace);
  state.modulator_mean = session.learner->returns.mean;
  state.modulator_std = session.learner->returns.deviation();
  state.rollbacks = agent.Rollbacks();
  return state;
}

}  // namespace

BoundDecision ToBound(Answer answer, const Policy& policy) {
  return {.answer = std::move(answer),
          .discrete = policy.action_space.is_discrete(),
          .config = policy.config};
}

nb::object ToPython(const ActionSpace& space) {
  if (space.is_discrete()) return nb::cast(DiscreteSpace{space.n});
  return nb::cast(BoxSpace{space.low, space.high});
}

nb::object StateOf(LocalSession& session) {
  BoundState state;
  {
    const nb::gil_scoped_release release;
    state = session.With(ReadState);
  }
  return nb::cast(std::move(state));
}

void BindValues(nb::module_& module) {
  BindSpaces(module);
  BindStats(module);
  BindDecision(module);
  BindBatch(module);
  BindSummaries(module);
  BindState(module);
}

}  // namespace spikeserve
