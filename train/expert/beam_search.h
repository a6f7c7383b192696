// Beam search for a short path to Acrobot's goal: expands every choice, keeps the most valuable
// states and stops at the first terminal state.
#pragma once

#include <vector>

#include "train/expert/value_table.h"

namespace spikeserve {

// Side lengths of a pruning box. Of several partial plans whose states fall into the same box, the
// search keeps only the one with the highest value.
inline constexpr double kBeamAngleBox = 0.07;     // rad
inline constexpr double kBeamVelocityBox = 0.14;  // rad/s

// Returns the choices that lead from `start` to a terminal state in as few steps as the beam finds,
// or an empty vector if it finds none within `max_steps`. Ranks states by `table` and keeps at most
// `width` partial plans after each step. A pure function; safe to call from many threads. REQUIRES:
// width >= 1; every step costs the same.
std::vector<int> BeamSearch(const Problem& problem, const ValueTable<4>& table,
                            const Grid<4>::State& start, int width, int max_steps);

}  // namespace spikeserve
