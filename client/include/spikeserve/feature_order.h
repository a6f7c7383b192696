// Puts the elements that a robot sends in the policy's order, and its actions back, by their names
// in OpenSessionRequest. Without names, everything stays as it is.
//
// Not thread-safe. Allocates no memory after construction.
#ifndef SPIKESERVE_FEATURE_ORDER_H_
#define SPIKESERVE_FEATURE_ORDER_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "absl/types/span.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

class FeatureOrder {
 public:
  FeatureOrder() = default;
  // REQUIRES: `opened` answers `request`, whose names the server has compared with the policy's.
  FeatureOrder(const v1::OpenSessionRequest& request, const v1::OpenSessionResponse& opened);

  // Returns an observation or the numbers of a Box action in the policy's order, valid until the
  // next call; unchanged if there are no names, or if the size is another one.
  absl::Span<const float> Observation(absl::Span<const float> robot);
  absl::Span<const float> Action(absl::Span<const float> robot);
  int64_t Action(int64_t robot) const;  // of a Discrete space

  // The reverse.
  absl::Span<const float> RobotObservation(absl::Span<const float> policy);
  absl::Span<const float> RobotAction(absl::Span<const float> policy);
  int64_t RobotAction(int64_t policy) const;

  // As above, within messages.
  void ToPolicy(v1::Action* action);
  void ToRobot(v1::ActResponse* response);

 private:
  // One list of names. `taken[i]` is the element of the robot that is element i of the policy.
  struct Places {
    std::vector<size_t> taken;  // empty: the orders are equal
    std::vector<float> buffer;

    absl::Span<const float> ToPolicy(absl::Span<const float> robot);
    absl::Span<const float> ToRobot(absl::Span<const float> policy);
  };

  Places observation_;
  Places action_;
};

}  // namespace spikeserve

#endif  // SPIKESERVE_FEATURE_ORDER_H_
