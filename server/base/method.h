// What the wire contract says about a method: its name, who may call it, and what a call costs.
//
// PolicyService and PolicyAdmin declare the rules of their methods as options, which
// policy_service.proto explains. GRPCInferenceService is the protocol of others, so the rules of
// its methods are in method.cc.
#pragma once

#include <cstddef>
#include <string>

#include "absl/strings/string_view.h"
#include "absl/types/span.h"

namespace google::protobuf {
class Descriptor;
}  // namespace google::protobuf

namespace spikeserve {

// The roles that may call a method.
enum class Access { kAnyRole, kAgentOrOperator, kViewerOrOperator, kOperatorOnly };

// What one call costs. Decides where it is answered, and which rate of the tenant counts it.
enum class Cost {
  kDecision,  // on the loop; each decision counts, see TenantLimits::decisions_per_second
  kLight,     // on the loop, because the work does not grow with the number of versions or sessions
  kListing,   // on a worker: what is listed may be long
  kExplain,   // on a worker: milliseconds of computing
  kOperator,  // on the worker of operators: may read and write files
};
inline constexpr size_t kCosts = 5;

constexpr bool RunsOnLoop(Cost cost) { return cost == Cost::kDecision || cost == Cost::kLight; }

// Immutable. There is one object for each method, which lives as long as the program.
struct Method {
  const std::string service;  // "spikeserve.v1.PolicyService"
  const std::string name;     // "Act"
  const std::string path;     // "/spikeserve.v1.PolicyService/Act"
  const bool streams;         // requests or responses
  const bool gathers;         // the messages of the client are one request
  const Access access;
  const Cost cost;
  const size_t index;  // in AllMethods()
};

// Returns the methods of PolicyService, PolicyAdmin and GRPCInferenceService. Thread-safe.
absl::Span<const Method> AllMethods();

// Returns the method of a name. No two services have a method of the same name. Thread-safe.
//
// REQUIRES: there is one.
const Method& MethodNamed(absl::string_view name);

// Returns the method with one response whose requests are of a type. Thread-safe.
//
// REQUIRES: there is exactly one.
const Method& MethodOf(const google::protobuf::Descriptor& request);

template <typename Request>
const Method& MethodOf() {
  return MethodOf(*Request::descriptor());
}

}  // namespace spikeserve
