// Random robots, links and servers in simulated time. Whatever happens: every control step has an
// action in time; no stale action runs; every reward is counted once; histories have no gap; and
// the server's session equals the one of a robot that never lost it.
//
// Free functions, for one thread at a time.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "core/robot/time.h"

namespace spikeserve::robot {

// A robot and its servers.
struct Kind {
  bool is_stored = true;
  size_t servers = 1;
  bool has_engine = false;
  bool shares_head = false;
  bool is_old = false;     // servers ignore ends on streams
  bool is_shared = false;  // the session's id, with another robot
  size_t kept_steps = 8192;
  bool sends_datagrams = false;
  Time oldest = std::chrono::milliseconds(250);  // as Settings, as the next
  int hold_steps = 3;
  bool is_calm = false;  // nothing happens by chance
};

struct Fault {
  enum class Kind {
    kReset,
    kCut,
    kBlackHole,
    kKill,
    kTakeOver,
    kDelay,
    kDeny,
    kSleep,
    kBusy,
    kIntruder,
    kFirewall
  };
  static constexpr int kKinds = 11;

  int step = 0;  // of the robot, before which it happens
  Kind kind = Kind::kReset;
  uint64_t random = 0;  // for how long, and at which server
};

// A flight as it will be. The seed is that of the robot's steps and of the link's delays.
struct Plan {
  uint64_t seed = 0;
  int steps = 1500;
  std::vector<Fault> faults = {};  // by step
};
Plan MakePlan(const Kind& kind, uint64_t seed);

struct Flight {
  uint64_t events = 0;
  uint64_t datagrams = 0;    // answers to them that have arrived
  std::string failure = "";  // the first one; empty: everything held
};
Flight Fly(const Kind& kind, const Plan& plan);

// A line of tests/scenarios/link_events.txt, which says what the fields are.
struct LinkEvent {
  std::vector<std::string> kinds;
  int steps = 0;
  std::string source;
  bool ends = false;
};
// Replays events, with nothing else that happens.
Flight Replay(const std::vector<LinkEvent>& events);

}  // namespace spikeserve::robot
