// Converts recorded episodes to CBOR (RFC 8949) and back: one object with the fields of dataset.h.
//
// Pure functions; safe to call from many threads.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/dataset/dataset.h"

namespace spikeserve {

std::string SerializeDataset(const Dataset& dataset);

// Returns INVALID_ARGUMENT if `bytes` is not a valid dataset.
absl::StatusOr<Dataset> ParseDataset(absl::string_view bytes);

}  // namespace spikeserve
