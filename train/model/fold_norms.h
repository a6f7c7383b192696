// Moves norms that are affine maps into the maps and coders around them.
//
// Pure and thread-safe.
#pragma once

#include "core/model/policy.h"

namespace spikeserve {

// Removes the norms of a policy whose norms stand for x_k <- weight_k x_k + bias_k. The embeddings,
// the maps whose outputs are added to the residual stream, and the gains of the coders change, so
// that every coder gets the same current up to rounding. REQUIRES: a valid policy with norms and
// spikes in float32.
void FoldNorms(Policy* policy);

}  // namespace spikeserve
