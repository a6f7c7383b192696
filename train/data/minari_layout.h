// The names in Minari's layout (version 0.5) of a dataset: DIR/data/main_data.hdf5 and
// DIR/data/metadata.json, where DIR is <Minari's root>/<dataset id>.
//
// Supports episodes with one Box observation of any shape and number type, which is flattened, and
// a Discrete, MultiDiscrete or Box action. Indices are counted from the space's start. The elements
// of a MultiDiscrete become one index of all combinations, in which the last element changes
// fastest. Data that Minari has no field for use its extension points: the actor is an attribute of
// the episode; labels, weights and returns-to-go are infos; environment and recipe are in the
// metadata. The labels and weights of every writer are read.
#pragma once

namespace spikeserve {

inline constexpr char kMinariMetadata[] = "/data/metadata.json";  // relative to DIR
inline constexpr char kMinariData[] = "/data/main_data.hdf5";     // relative to DIR
inline constexpr char kMinariExtension[] = "spikeserve";  // this project's key in the metadata

}  // namespace spikeserve
