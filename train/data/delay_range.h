// The delay with which decisions are executed. A plain value.
#pragma once

namespace spikeserve {

// The steps between an observation and the effect of its decision, at least and at most. With a
// delay of k steps, what is decided at step t is executed at step t + k, so the action to imitate
// at step t is the label of step t + k. The last k decisions of an episode are never executed: they
// have weight 0.
struct DelayRange {
  int least = 0;
  int most = 0;  // >= least
};

}  // namespace spikeserve
