// What both streaming engines do with a policy: they pack its weights, and may then free what they
// were packed from. Private to this folder; thread-safe, like every engine.
#pragma once

#include <memory>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/engine/engine.h"
#include "core/engine/spiking/kernels/targets.h"

namespace spikeserve {

// `Packed` is PackedWeights or PackedIntegerPolicy.
template <class Packed>
class PackedEngine : public Engine {
 public:
  explicit PackedEngine(std::shared_ptr<const Policy> policy)
      : PackedEngine(policy, Packed(*policy)) {}
  PackedEngine(std::shared_ptr<const Policy> policy, Packed packed)
      : policy_(std::move(policy)), packed_(std::move(packed)) {
    kernels::ChooseTarget();
  }

  const Policy& policy() const final { return *policy_; }

  Policy CompletePolicy() const final {
    Policy policy = *policy_;
    packed_.RestoreTo(&policy.weights);
    return policy;
  }

 protected:
  const Packed& packed() const { return packed_; }

 private:
  std::shared_ptr<const Policy> policy_;
  Packed packed_;
};

// See MakeCompactSpikingEngine (streaming_engine.h). `EngineType` is a PackedEngine<Packed>.
template <class EngineType, class Packed>
absl::StatusOr<std::unique_ptr<Engine>> MakeCompact(Policy policy, const std::string& folder) {
  Packed packed(policy);
  if (!folder.empty()) {
    if (absl::Status status = packed.ShareRows(folder); !status.ok()) return status;
  }
  packed.DropFrom(&policy.weights);
  return std::make_unique<EngineType>(std::make_shared<const Policy>(std::move(policy)),
                                      std::move(packed));
}

}  // namespace spikeserve
