// Converts a session to bytes and back.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "core/session/session.h"

namespace spikeserve {

// The name of the binary form, with which it begins.
inline constexpr char kSessionFormat[] = "spikeserve.session.v1";

// Converts a session to a compact binary form (CBOR).
std::string SerializeSession(const Session& session);
// Converts the binary form back to a session that is equal bit for bit. INVALID_ARGUMENT if `bytes`
// is not such a form or not a possible session.
absl::StatusOr<Session> ParseSession(const std::string& bytes);

}  // namespace spikeserve
