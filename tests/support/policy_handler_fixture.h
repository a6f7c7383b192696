// A fixture for tests of what agents ask for, without a network.
#pragma once

#include <gtest/gtest.h>

#include <cstdint>
#include <memory>
#include <string>

#include "server/access/authenticator.h"
#include "server/agent/policy_handler.h"
#include "server/followers/shadow_runner.h"
#include "tests/support/fake_clock.h"
#include "tests/support/small_registry.h"

namespace spikeserve {

// Has a handler that serves a random policy "small" to one caller, who may do everything.
class PolicyHandlerFixture : public ::testing::Test {
 protected:
  // Opens a session of the policy "small" and returns its id.
  std::string MustOpen(v1::OpenSessionRequest request = {}) {
    request.set_policy("small");
    v1::OpenSessionResponse response;
    CallContext context{.caller = caller_.get()};
    const auto status = handler_.OpenSession(context, request, &response);
    EXPECT_TRUE(status.ok()) << status;
    return response.session_id();
  }

  absl::Status Decide(const v1::ActRequest& request, v1::ActResponse* response,
                      DeferredWork* deferred) {
    CallContext context{.caller = caller_.get(), .deferred = deferred};
    return handler_.Act(context, request, response);
  }

  static v1::ActRequest MakeRequest(const std::string& session, int64_t step) {
    v1::ActRequest request;
    request.set_session_id(session);
    request.set_step(step);
    for (const float value : ObservationAt(step)) request.add_observation(value);
    return request;
  }

  FakeClock clock_;
  std::unique_ptr<Authenticator> authenticator_ = *Authenticator::Create("");
  const std::shared_ptr<const Credential> caller_ = *authenticator_->Authenticate("");
  SmallRegistry registry_{"small"};
  ShadowRunner shadows_{registry_.metrics().registry()};
  SessionStore store_{100, &clock_};
  SessionGate gate_{&store_};
  PolicyHandler handler_{registry_.get(), &gate_, &shadows_, &clock_};
};

}  // namespace spikeserve
