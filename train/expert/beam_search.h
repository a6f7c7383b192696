// Beam search for the shortest way to Acrobot's goal: expand every choice, keep the most valuable
// states, stop at the first goal.
#ifndef TRAIN_EXPERT_BEAM_SEARCH_H_
#define TRAIN_EXPERT_BEAM_SEARCH_H_

#include <vector>

#include "train/expert/value_table.h"

namespace spikeserve {

// A partial plan whose state falls into the same box as a better one's is dropped; the sides of the
// box.
inline constexpr double kBeamAngleBox = 0.07;     // rad
inline constexpr double kBeamVelocityBox = 0.14;  // rad/s

// The choices that lead from `start` to a terminal state in as few steps as the beam finds, ranking
// states by `table`; empty if there are none within `max_steps`. `width` partial plans survive a
// step. Pure; safe to call from many threads. REQUIRES: width >= 1; every step costs the same.
std::vector<int> BeamSearch(const Problem& problem, const ValueTable<4>& table,
                            const Grid<4>::State& start, int width, int max_steps);

}  // namespace spikeserve

#endif  // TRAIN_EXPERT_BEAM_SEARCH_H_
