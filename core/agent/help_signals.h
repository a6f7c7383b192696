// Judges how much a session needs a person's help, from running averages of its last decisions.
//
//   HelpSignals signals;
//   signals.OnDecision(answer);
//   const Help help = signals.Now(/*lacking=*/0.0, /*range=*/500.0);
//
// Not part of the session's value: the next server begins anew. Not thread-safe.
#pragma once

#include <cstdint>

#include "core/agent/robot_link.h"
#include "core/session/session.h"

namespace spikeserve {

// What speaks for help, each part in [0, 1].
struct Help {
  double unusual_observations = 0.0;  // share of the last decisions with an unusual element
  double entropy = 0.0;               // of their probabilities, as a share of ln n; 0 for a Box
  double low_return = 0.0;            // what is lacking, as a share of the range
  double fallbacks = 0.0;             // share of the last report's beats that had no fresh answer

  // Less than this is nothing.
  static constexpr double kLeast = 0.01;

  double score() const { return unusual_observations + entropy + low_return + fallbacks; }
  bool is_needed() const { return score() >= kLeast; }
};

// Allocates no memory.
class HelpSignals {
 public:
  static constexpr int64_t kMemory = 50;  // decisions: a step counts for about this many

  void OnDecision(const Answer& answer);
  // Takes the counts that a robot's report adds to the one before.
  void OnReport(const BeatCounts& added);
  // Takes by how much the return of an episode was below its forecast; negative: above.
  void OnEpisode(double lacking) { lacking_ = lacking; }

  // `lacking` is by how much the running episode is already known to end below its target; the
  // episode before counts if that is more. `range` > 0 is that of the policy's returns.
  Help Now(double lacking, double range) const;

 private:
  int64_t decisions_ = 0;
  double unusual_ = 0.0;
  double entropy_ = 0.0;
  double fallbacks_ = 0.0;
  double lacking_ = 0.0;
};

}  // namespace spikeserve
