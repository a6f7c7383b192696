// Decompresses what clients compressed.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstddef>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the bytes that `compressed`, one member of the gzip format (RFC 1952), stands for.
// Returns INVALID_ARGUMENT if it is no such member, RESOURCE_EXHAUSTED if it stands for more than
// `limit` bytes; neither is decompressed further than that.
absl::StatusOr<std::string> Gunzip(absl::string_view compressed, size_t limit);

}  // namespace spikeserve
