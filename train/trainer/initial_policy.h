// Creates the policy that training starts from.
#pragma once

#include <cstdint>

#include "core/model/policy.h"
#include "train/data/dataset.h"
#include "train/data/episode_source.h"
#include "train/model/patch_embedding.h"

namespace spikeserve {

// Returns the moments of the actions to imitate, as ActionSpace::Encode maps them, [act]; both
// empty for a Discrete space.
Moments EncodedLabels(const EpisodeSource& source);

// Returns a policy with random weights, drawn from `seed`. For a Box, the action embedding and the
// head start as if the bounds were those of the data: their inputs and outputs have the moments of
// EncodedLabels(). Observations are standardised by the
// moments of the data: of each entry, or with patches of each channel of an image. Returns are
// scaled by ReturnScalingOf(), or by the moments of the data for an environment that it does not
// know. REQUIRES: a valid config.
Policy InitialPolicy(const ModelConfig& config, const EpisodeSource& source, uint64_t seed,
                     const PatchShape& patches = {});

}  // namespace spikeserve
