// The parts of a server that fuzz targets send requests to: a policy "small" and its sessions,
// without a network.
#pragma once

#include <memory>

#include "core/learning/fleet_head.h"
#include "server/access/authenticator.h"
#include "server/agent/policy_handler.h"
#include "server/followers/shadow_runner.h"
#include "tests/fuzz/fuzz_target.h"
#include "tests/support/fake_clock.h"
#include "tests/support/small_registry.h"

namespace spikeserve {

// Not thread-safe.
class FuzzedServer {
 public:
  static constexpr int64_t kMaxSessions = 6;

  FuzzedServer() = default;
  // Makes the shared head forget what its sessions have taught it, so that an input does not depend
  // on those before it.
  ~FuzzedServer() { Shared().fleet().Restore(Shared().untaught); }
  FuzzedServer(const FuzzedServer&) = delete;
  FuzzedServer& operator=(const FuzzedServer&) = delete;

  const Credential& caller() const { return *caller_; }
  CallContext NewContext(DeferredWork* deferred = nullptr) const {
    return {.caller = caller_.get(), .deferred = deferred};
  }
  const std::shared_ptr<const Credential>& shared_caller() const { return caller_; }
  PolicyRegistry* registry() { return Shared().registry.get(); }
  SessionStore& store() { return store_; }
  const SessionGate& gate() const { return gate_; }
  FakeClock& clock() { return clock_; }
  const PolicyHandler& handler() const { return handler_; }

 private:
  // Parts that keep nothing of a session but the shared head, and take long to make.
  struct Parts {
    SmallRegistry registry{"small"};
    ShadowRunner shadows{registry.metrics().registry()};
    std::unique_ptr<Authenticator> authenticator = *Authenticator::Create("");
    const FleetHead::State untaught = fleet().state();

    FleetHead& fleet() { return *(*registry.get()->catalog()->Find("small", 1))->HeadOf(""); }
  };
  static Parts& Shared() {
    static auto* const parts = new Parts;  // lives as long as the process
    return *parts;
  }

  FakeClock clock_;
  const std::shared_ptr<const Credential> caller_ = *Shared().authenticator->Authenticate("");
  SessionStore store_{kMaxSessions, &clock_};
  SessionGate gate_{&store_};
  PolicyHandler handler_{Shared().registry.get(), &gate_, &Shared().shadows, &clock_};
};

}  // namespace spikeserve
