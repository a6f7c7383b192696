// Estimates the energy of counted operations by several models.
//
// Estimates, never measurements. The models answer different questions, so figures of different
// models are never added or sorted together. Each model names what it counts, what it leaves out
// and to which policies it applies; docs/reference/energy.md, `spikectl` and the status page show
// these texts. All functions are pure and thread-safe. Example:
//
//   const auto joules = EstimateEnergy(EnergyModel::kInt45nm, output.counts, policy.config);
//   if (joules.has_value()) ...  // the model applies to this policy
#pragma once

#include <array>
#include <optional>

#include "absl/strings/string_view.h"
#include "core/base/enum_names.h"
#include "core/engine/counts.h"
#include "core/model/config.h"

namespace spikeserve {

// In the order in which they are shown: the first that applies to a policy leads, which is the one
// with memory for policies in integers.
enum class EnergyModel { kIntSram45nm, kInt45nm, kHorowitz45nm, kSpike5pj };
inline constexpr int kEnergyModels = 4;

constexpr std::array<EnumName<EnergyModel>, kEnergyModels> EnumNames(EnergyModel) {
  return {{{EnergyModel::kIntSram45nm, "int_sram_45nm"},
           {EnergyModel::kInt45nm, "int_45nm"},
           {EnergyModel::kHorowitz45nm, "horowitz_45nm"},
           {EnergyModel::kSpike5pj, "spike_5pj"}}};
}

// The model of totals over policies and of every stored figure that names no other: it applies to
// every policy, so that they can use it alone.
inline constexpr EnergyModel kDefaultEnergyModel = EnergyModel::kHorowitz45nm;

// What to know about a model before reading its figures.
struct EnergyModelInfo {
  absl::string_view counts;      // what it prices, with the prices
  absl::string_view leaves_out;  // what it does not price
  absl::string_view applies_to;  // which policies have a figure under it
  absl::string_view source;      // of the prices
};
const EnergyModelInfo& InfoOf(EnergyModel model);

// Returns whether policies of this configuration have a figure under the model.
bool Applies(EnergyModel model, const ModelConfig& config);

// Returns the energy of `counts` in joules, or nothing if the model does not apply to `config`.
std::optional<double> EstimateEnergy(EnergyModel model, const Counts& counts,
                                     const ModelConfig& config);

// Returns the estimate by kDefaultEnergyModel, in joules.
double DefaultEnergy(const Counts& counts, const ModelConfig& config);

}  // namespace spikeserve
