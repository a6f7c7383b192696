// The data of the report's figures, which lab/report/plot.py draws with matplotlib.
//
// Pure functions of plain values.
#pragma once

#include "lab/report/report_runs.h"
#include "nlohmann/json.hpp"

namespace spikeserve {

// Returns an object with one member for each figure. The member's name is the name of the figure's
// file without ".png". A figure without data has no member. Tasks stand in the order of
// `options.environments`, and every run is that of seed 1 unless stated otherwise.
//
//   losses              {task: {"unit": string, "modes": {mode: [[[iteration, loss], ...], ...]}}},
//                       a curve for each seed
//   spikes_by_stage     {task: {mode: {stage: mean spikes per decision}}}, spiking modes
//   spikes_per_decision {task: {mode: {"edges": [bins + 1], "decisions": [bins]}}}, histograms of
//                       one episode in the modes baseline and full; bin i holds edges[i] <= spikes
//                       < edges[i + 1]
//   phases              {task: [[omega in rad per timestep, phi in rad], ...]}, every generator of
//                       every seed in full mode
//   phase_spikes        {"task": string, "timesteps": N, "heads": [[time in timesteps, ...], ...]},
//                       the first task's generators over a window of N timesteps, in full mode
//   gates               {task: {mode: [H][tokens]}}, see Insight::gates, in the modes route and
//                       full
//   membrane            {"threshold": V_th, "potentials": [[input current, [V before the first
//                       tick, V after tick 1, ...]], ...]}, one untrained neuron
//   surrogates          {"slope": k, "curves": {kind: [[V - V_th, ds/du], ...]}}
//
// REQUIRES: `groups` holds every mode of every task.
nlohmann::ordered_json FigureData(const ReportOptions& options, const ReportGroups& groups);

}  // namespace spikeserve
