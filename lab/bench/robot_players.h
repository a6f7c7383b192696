// Two ways in which a robot gets its actions from a server: a call per beat, and a pilot.
//
// Not thread-safe; each robot owns its player.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/time/time.h"
#include "absl/types/span.h"
#include "spikeserve/client.h"
#include "spikeserve/pilot_options.h"
#include "spikeserve/pilot_stats.h"

namespace spikeserve {

// What a robot executes in one beat.
struct Executed {
  std::vector<float> action;
  ActionSource source = ActionSource::kSafe;
  absl::Duration age;  // from the observation that the action was chosen for
};

// What the server counted in all episodes, compared with the robot.
struct Comparison {
  int64_t doubled = 0;  // beats that the server has and the robot has not played
  int64_t missing = 0;  // beats that the server has not

  void Add(const Comparison& other) {
    doubled += other.doubled;
    missing += other.missing;
  }
};

class RobotPlayer {
 public:
  virtual ~RobotPlayer() = default;

  virtual Executed Act(absl::Span<const float> observation, double reward) = 0;
  // Ends an episode of `beats` beats.
  virtual void EndEpisode(double reward, int64_t beats) = 0;
  // Ends the session.
  virtual Comparison Finish() = 0;
};

struct PlayerOptions {
  std::string servers;
  std::string policy;
  absl::Duration period;
  // Of a pilot.
  bool has_engine = false;  // on the robot
  PilotTransport transport = PilotTransport::kStream;
  int redundancy = 1;
};

// Connects the client of one or more pilots.
absl::StatusOr<std::shared_ptr<Client>> Connect(const PlayerOptions& options);

// Calls Act at every beat. Gives up after nine tenths of the period and holds the last action.
absl::StatusOr<std::unique_ptr<RobotPlayer>> MakeCaller(const PlayerOptions& options);

absl::StatusOr<std::unique_ptr<RobotPlayer>> MakePilot(const PlayerOptions& options,
                                                       std::shared_ptr<Client> client);

}  // namespace spikeserve
