// What a robot sends, as dicts with the names of the wire contract's fields, from which Python
// makes the messages: the extension links no protobuf.
//
// The caller holds Python's global interpreter lock and the lock of the session.
#pragma once

#include <nanobind/nanobind.h>

#include <chrono>

#include "core/robot/robot_session.h"

namespace spikeserve::robot {

inline double SecondsOf(Time time) { return std::chrono::duration<double>(time).count(); }

// Returns the fields of an ActRequest without the session's id and `valid_until`.
nanobind::dict FieldsOf(const StepLog& log, const Request& request);
// Returns the fields of the EndEpisodeRequest of the oldest episode without the session's id.
nanobind::dict EndFieldsOf(const StepLog& log);

}  // namespace spikeserve::robot
