#include "server/base/method.h"

#include <set>
#include <string>

#include "gtest/gtest.h"
#include "inference/grpc_service.pb.h"
#include "spikeserve/v1/policy_admin.pb.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {
namespace {

TEST(MethodTest, EveryMethodOfTheContractDeclaresItsRules) {
  for (const auto* service : {v1::ActRequest::descriptor()->file()->service(0),
                              v1::LoadPolicyRequest::descriptor()->file()->service(0)}) {
    for (int i = 0; i < service->method_count(); ++i) {
      const auto& method = *service->method(i);
      const v1::MethodRules& rules = method.options().GetExtension(v1::rules);
      EXPECT_NE(rules.access(), v1::MethodRules::ACCESS_UNSPECIFIED) << method.full_name();
      EXPECT_NE(rules.cost(), v1::MethodRules::COST_UNSPECIFIED) << method.full_name();
    }
  }
}

TEST(MethodTest, WhatChangesNothingIsDeclaredSo) {
  const auto* admin = v1::LoadPolicyRequest::descriptor()->file()->service(0);
  for (int i = 0; i < admin->method_count(); ++i) {
    const auto& declared = *admin->method(i);
    const bool reads =
        declared.options().idempotency_level() == google::protobuf::MethodOptions::NO_SIDE_EFFECTS;
    // Only operators change what is served, and read a policy's weights.
    EXPECT_EQ(reads && declared.name() != "PullPolicy",
              MethodNamed(declared.name()).access != Access::kOperatorOnly)
        << declared.full_name();
  }
}

TEST(MethodTest, MethodsAreFoundByNameAndByRequest) {
  std::set<std::string> names;
  for (const Method& method : AllMethods()) {
    EXPECT_TRUE(names.insert(method.name).second) << method.name;
    EXPECT_EQ(&MethodNamed(method.name), &method);
    EXPECT_EQ(&AllMethods()[method.index], &method);
    EXPECT_EQ(method.path, "/" + method.service + "/" + method.name);
  }
  EXPECT_EQ(names.size(), 52);
  EXPECT_EQ(&MethodOf<v1::SetLabelRequest>(), &MethodNamed("SetLabel"));
  // Act and ActStream have the same requests.
  EXPECT_EQ(&MethodOf<v1::ActRequest>(), &MethodNamed("Act"));
  EXPECT_EQ(&MethodOf<inference::ModelInferRequest>(), &MethodNamed("ModelInfer"));
}

TEST(MethodDeathTest, AnUnknownNameIsAMistakeOfThisProgram) {
  EXPECT_DEATH(MethodNamed("Fly"), "the method exists.*Fly");
}

}  // namespace
}  // namespace spikeserve
