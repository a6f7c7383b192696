#include "server/base/method.h"

#include <algorithm>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/contract/dcheck.h"
#include "google/protobuf/descriptor.h"
#include "inference/grpc_service.pb.h"
#include "spikeserve/v1/policy_admin.pb.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {
namespace {

using google::protobuf::MethodDescriptor;
using google::protobuf::ServiceDescriptor;

// The rules of one method, from its options or from the table below.
struct Rules {
  Access access;
  Cost cost;
};

// The methods of the Open Inference Protocol, whose file is not ours to change.
struct InferenceMethod {
  absl::string_view name;
  Rules rules;
};
constexpr InferenceMethod kInferenceMethods[] = {
    {"ServerLive", {Access::kAnyRole, Cost::kLight}},
    {"ServerReady", {Access::kAnyRole, Cost::kLight}},
    {"ModelReady", {Access::kAnyRole, Cost::kLight}},
    {"ServerMetadata", {Access::kAnyRole, Cost::kLight}},
    {"ModelMetadata", {Access::kAnyRole, Cost::kListing}},
    {"ModelInfer", {Access::kAgentOrOperator, Cost::kDecision}},
    {"ModelStreamInfer", {Access::kAgentOrOperator, Cost::kDecision}},
    {"ModelConfig", {Access::kAnyRole, Cost::kLight}},
    {"ModelStatistics", {Access::kViewerOrOperator, Cost::kListing}},
    {"RepositoryIndex", {Access::kAnyRole, Cost::kListing}},
    {"RepositoryModelLoad", {Access::kOperatorOnly, Cost::kOperator}},
    {"RepositoryModelUnload", {Access::kOperatorOnly, Cost::kOperator}},
};

Access AccessOf(v1::MethodRules::Access access) {
  switch (access) {
    case v1::MethodRules::ACCESS_ANY_ROLE:
      return Access::kAnyRole;
    case v1::MethodRules::ACCESS_AGENT:
      return Access::kAgentOrOperator;
    case v1::MethodRules::ACCESS_VIEWER:
      return Access::kViewerOrOperator;
    default:  // a method without a rule is the operators'
      return Access::kOperatorOnly;
  }
}

Cost CostOf(v1::MethodRules::Cost cost) {
  switch (cost) {
    case v1::MethodRules::COST_DECISION:
      return Cost::kDecision;
    case v1::MethodRules::COST_LIGHT:
      return Cost::kLight;
    case v1::MethodRules::COST_LISTING:
      return Cost::kListing;
    case v1::MethodRules::COST_EXPLAIN:
      return Cost::kExplain;
    default:
      return Cost::kOperator;
  }
}

// Returns null if the method is not served.
const Rules* RulesOfInference(const MethodDescriptor& method) {
  for (const InferenceMethod& known : kInferenceMethods) {
    if (known.name == method.name()) return &known.rules;
  }
  return nullptr;
}

// Appends the methods of `service` to `methods`. Methods of the Open Inference Protocol that are
// not served have no rules, and are left out.
void Append(const ServiceDescriptor& service, std::vector<Method>& methods) {
  for (int i = 0; i < service.method_count(); ++i) {
    const MethodDescriptor& method = *service.method(i);
    const v1::MethodRules& declared = method.options().GetExtension(v1::rules);
    Rules rules = {AccessOf(declared.access()), CostOf(declared.cost())};
    if (!method.options().HasExtension(v1::rules)) {
      const Rules* known = RulesOfInference(method);
      if (known == nullptr) continue;
      rules = *known;
    }
    methods.push_back({.service = service.full_name(),
                       .name = method.name(),
                       .path = absl::StrCat("/", service.full_name(), "/", method.name()),
                       .streams = method.client_streaming() || method.server_streaming(),
                       .gathers = method.client_streaming() && !method.server_streaming(),
                       .access = rules.access,
                       .cost = rules.cost,
                       .index = methods.size()});
  }
}

}  // namespace

absl::Span<const Method> AllMethods() {
  static const auto& methods = *[] {
    auto* all = new std::vector<Method>;
    Append(*v1::ActRequest::descriptor()->file()->service(0), *all);
    Append(*v1::LoadPolicyRequest::descriptor()->file()->service(0), *all);
    Append(*inference::ServerLiveRequest::descriptor()->file()->service(0), *all);
    return all;
  }();
  return methods;
}

const Method& MethodNamed(absl::string_view name) {
  const auto methods = AllMethods();
  const auto found =
      std::find_if(methods.begin(), methods.end(), [&](const Method& m) { return m.name == name; });
  if (found == methods.end()) FailDCheck(__FILE__, __LINE__, "the method exists", name);
  return *found;
}

const Method& MethodOf(const google::protobuf::Descriptor& request) {
  const auto* service = request.file()->service(0);
  for (int i = 0; i < service->method_count(); ++i) {
    const MethodDescriptor& method = *service->method(i);
    if (method.input_type() == &request && !method.server_streaming()) {
      return MethodNamed(method.name());
    }
  }
  FailDCheck(__FILE__, __LINE__, "a method has these requests", request.full_name());
}

}  // namespace spikeserve
