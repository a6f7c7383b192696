// What happens on the link of a robot, and what its session wants to be done there. Plain values.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "core/robot/action_shape.h"
#include "core/robot/step_log.h"
#include "core/robot/time.h"
#include "core/robot/transport_choice.h"

namespace spikeserve::robot {

// What a failed call or request says about the session.
enum class Failure {
  kNotFound,  // this server does not have it: NOT_FOUND
  kConflict,  // it differs from the robot's: FAILED_PRECONDITION, DATA_LOSS
  kInvalid,   // a step is not valid: INVALID_ARGUMENT
  kAway,      // nothing; the server cannot be reached: UNAVAILABLE, DEADLINE_EXCEEDED
  kOther,
};

struct Error {
  Failure kind = Failure::kOther;
  std::string message = {};
  std::string text = {};                                     // for the log, with the code
  std::optional<uint64_t> expected_decision = std::nullopt;  // that the server named
  std::optional<int64_t> expected_episode = std::nullopt;    // of it
  std::optional<Time> retry_after = std::nullopt;
};

// A reply on the stream. The replies follow the order of the requests.
struct Reply {
  const Error* error = nullptr;  // otherwise the rest counts
  int64_t next_step = 0;         // that the server expects
  std::optional<ActionView> action = std::nullopt;
  ChooserView chooser = {};     // of the action; kUnknown: the policy
  Time observed_at = kLongAgo;  // of the action
  // The robot is to stay at its safe action until an answer without that: the session is held, or
  // its observations look miswired.
  bool stays_safe = false;
  uint64_t durable_decision = 0;  // decisions that the store has
  int64_t durable_episode = 0;    // ends of episodes that the store has
  bool has_ended = false;         // the episode
  // Its return at the server; absent: a server that repeats its answer may not know it any more.
  std::optional<double> episode_return = std::nullopt;
};

// An episode whose end the server has answered for the first time, or again, with the robot's own
// figures.
struct Settled {
  uint64_t serial;
  uint64_t steps;
  uint64_t lost_steps;
  double episode_return;
};

struct Received {
  std::optional<Settled> settled = std::nullopt;
  bool has_work = false;  // RobotSession::Next may have more than to wait
};

// The server's answer to OpenSession.
struct Opening {
  int64_t history_limit = 0;
  bool is_stored = false;  // the other servers may have the session, too
};

// What is to be done on the link.
struct Task {
  enum class Kind {
    kWait,         // until `time`, or an event
    kForget,       // the session is lost: close the stream, and any call but OpenSession; the
                   // summaries of episodes before `serial` fail because of `reason`
    kSend,         // `request`, by each of `ways`
    kPlay,         // RobotSession::work() on the robot's engine
    kOpenSession,  // with the same id until it is answered
    kOpenStream,   // at a server that has not denied the session
    kCloseStream,
    kDoubtLine,  // there were no answers since `time`: try a fresh connection
    kExportSession,
    kEndEpisode,  // the oldest one, by a call
    kStop,        // everything; the robot has closed the session
  };

  Kind kind = Kind::kWait;
  Time time = kNever;
  Request request = {};
  Ways ways = {};
  uint64_t datagram = 0;  // number of the datagram, which its answer has, too
  int copies = 1;         // of the datagram
  uint64_t serial = 0;
  std::string reason = {};
};

}  // namespace spikeserve::robot
