// A fixture in which an operator changes the served versions of the policy `discrete` of a real
// server.
#ifndef TESTS_INTEGRATION_POLICY_ADMIN_FIXTURE_H_
#define TESTS_INTEGRATION_POLICY_ADMIN_FIXTURE_H_

#include <filesystem>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "grpc/health/v1/health.grpc.pb.h"
#include "spikeserve/v1/policy_admin.grpc.pb.h"
#include "tests/integration/server_fixture.h"

namespace spikeserve {

class PolicyAdminTest : public ServerTest {
 protected:
  void SetUp() override {
    ServerTest::SetUp();
    Connect();
  }

  void Connect() { admin_ = v1::PolicyAdmin::NewStub(client_->channel()); }

  void AddVersion(int version) {
    WriteRandomPolicy(policies_.path(), "discrete", version, ActionSpace::Discrete(2));
  }
  std::filesystem::path FileOf(int version) {
    return policies_.path() / "discrete" / absl::StrCat(version) / "policy.safetensors";
  }

  template <typename Request, typename Response>
  Response Must(grpc::Status (v1::PolicyAdmin::Stub::*method)(grpc::ClientContext*, const Request&,
                                                              Response*),
                const Request& request) {
    Response response;
    const auto status = ((*admin_).*method)(NewContext().get(), request, &response);
    EXPECT_TRUE(status.ok()) << status.error_message();
    return response;
  }

  grpc::Status TryUnload(int version) {
    v1::UnloadPolicyRequest request;
    request.set_policy("discrete");
    request.set_version(version);
    v1::UnloadPolicyResponse response;
    return admin_->UnloadPolicy(NewContext().get(), request, &response);
  }

  grpc::Status TryLoad(int version, bool make_default = false) {
    v1::LoadPolicyRequest request;
    request.set_policy("discrete");
    request.set_version(version);
    request.set_make_default(make_default);
    v1::LoadPolicyResponse response;
    return admin_->LoadPolicy(NewContext().get(), request, &response);
  }

  v1::ReloadPoliciesResponse Reload() {
    return Must(&v1::PolicyAdmin::Stub::ReloadPolicies, v1::ReloadPoliciesRequest());
  }

  void SetDefault(int version) {
    v1::SetDefaultVersionRequest request;
    request.set_policy("discrete");
    request.set_version(version);
    Must(&v1::PolicyAdmin::Stub::SetDefaultVersion, request);
  }

  void SetLabel(const std::string& label, int version) {
    v1::SetLabelRequest request;
    request.set_policy("discrete");
    request.set_label(label);
    request.set_version(version);
    Must(&v1::PolicyAdmin::Stub::SetLabel, request);
  }

  static v1::SetTrafficRequest Traffic(const std::map<int, int>& percents, int shadow = 0) {
    v1::SetTrafficRequest request;
    request.set_policy("discrete");
    for (const auto& [version, percent] : percents) {
      auto* share = request.add_shares();
      share->set_version(version);
      share->set_percent(percent);
    }
    request.set_shadow_version(shadow);
    return request;
  }

  v1::OpenSessionResponse Open(const std::string& label = "", const std::string& key = "") {
    v1::OpenSessionRequest request;
    request.set_policy("discrete");
    request.set_version_label(label);
    request.set_routing_key(key);
    v1::OpenSessionResponse response;
    const auto status = client_->stub().OpenSession(NewContext().get(), request, &response);
    EXPECT_TRUE(status.ok()) << status.error_message();
    return response;
  }

  int64_t DefaultVersion() { return Open().version(); }

  std::vector<int64_t> Versions() {
    v1::ListPoliciesResponse list;
    const auto status = client_->stub().ListPolicies(NewContext().get(), {}, &list);
    EXPECT_TRUE(status.ok()) << status.error_message();
    std::vector<int64_t> versions;
    for (const auto& policy : list.policies()) {
      if (policy.name() == "discrete") versions.push_back(policy.version());
    }
    return versions;
  }

  grpc::health::v1::HealthCheckResponse::ServingStatus Health(const std::string& service) {
    grpc::health::v1::HealthCheckRequest request;
    request.set_service(service);
    grpc::health::v1::HealthCheckResponse response;
    const auto health = grpc::health::v1::Health::NewStub(client_->channel());
    const auto status = health->Check(NewContext().get(), request, &response);
    EXPECT_TRUE(status.ok()) << status.error_message();
    return response.status();
  }

  std::unique_ptr<v1::PolicyAdmin::Stub> admin_;
};

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_POLICY_ADMIN_FIXTURE_H_
