// Defines the form in which a session leaves its server, so that a robot continues with it alone.
//
//   std::string value = ExportSession(agent);                   // on the server
//   absl::StatusOr<Session> session = ImportSession(value);     // on the robot
//
// The form is that of a session (session.h), which begins with the name of its format, with a
// checksum behind it: bytes that were changed or cut off on their way are refused. It is not
// encrypted, and the checksum proves no origin.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "core/agent/agent_session.h"
#include "core/session/session.h"

namespace spikeserve {

// Returns whether the session goes on without learning where it is imported: one of a fleet, whose
// shared head is exported as it is now.
bool IsFrozenByExport(const Session& session);

// Returns the value of the session. Sessions that are equal but for the time that the last answer
// took give equal bytes.
std::string ExportSession(const AgentSession& agent);

// Returns the session. INVALID_ARGUMENT if `value` was not exported, was damaged since, or has the
// format of another release.
absl::StatusOr<Session> ImportSession(absl::string_view value);

}  // namespace spikeserve
