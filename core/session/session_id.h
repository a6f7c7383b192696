// Draws the ids of sessions, and refuses those that are not known.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns 128 random bits from the kernel in hexadecimal, so that the ids of other agents' sessions
// cannot be guessed.
absl::StatusOr<std::string> NewSessionId();

// Returns NOT_FOUND: no session with this id is visible to the caller.
absl::Status NoSuchSession(absl::string_view id);

}  // namespace spikeserve
