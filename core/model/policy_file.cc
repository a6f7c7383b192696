#include "core/model/policy_file.h"

#include <utility>
#include <variant>

#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/model/policy_metadata.h"
#include "core/model/safetensors.h"

namespace spikeserve {
namespace {

// Returns the length of observation.mean, which determines the observation size, or 0 if there is
// no such tensor.
int ObservationSize(const Safetensors& contents) {
  const auto found = contents.tensors.find("observation.mean");
  if (found == contents.tensors.end()) return 0;
  return std::visit([](const auto& tensor) { return static_cast<int>(tensor.values.size()); },
                    found->second);
}

// Moves `tensor` to `place`. INVALID_ARGUMENT if it has another dtype.
template <class Typed>
absl::Status Take(const std::string& name, AnyTensor tensor, Typed* place) {
  if (auto* const typed = std::get_if<Typed>(&tensor)) {
    *place = std::move(*typed);
    return absl::OkStatus();
  }
  return InvalidArgument(absl::StrCat("tensor ", Quoted(name)),
                         absl::StrCat("dtype ", Quoted(DtypeName(Typed()))),
                         Quoted(DtypeName(tensor)));
}

// Moves every tensor to its place in `policy`. Policy::Validate checks the shapes and the numbers.
absl::Status TakeTensors(Safetensors& contents, Policy* policy) {
  const int observation_size = ObservationSize(contents);
  for (const TensorSlot& slot : TensorSlots(policy->config, observation_size,
                                            policy->action_space.size(), &policy->weights)) {
    auto node = contents.tensors.extract(slot.name);
    if (node.empty()) {
      return absl::InvalidArgumentError(
          absl::StrCat("tensor ", Quoted(slot.name), ": expected, but missing"));
    }
    RETURN_IF_ERROR(
        std::visit([&](auto* place) { return Take(slot.name, std::move(node.mapped()), place); },
                   slot.tensor));
  }
  if (contents.tensors.empty()) return absl::OkStatus();
  return absl::InvalidArgumentError(absl::StrCat(
      "tensor ", Quoted(contents.tensors.begin()->first), ": not expected in a policy of mode ",
      std::string(ToString(policy->config.mode)), " in ",
      std::string(ToString(policy->config.arithmetic)),
      policy->config.has_norms() ? "" : " without norms"));
}

}  // namespace

absl::StatusOr<Policy> ParsePolicyFile(absl::string_view bytes) {
  ASSIGN_OR_RETURN(Safetensors contents, ParseSafetensors(bytes));
  Policy policy;
  absl::Status status = ParsePolicyMetadata(contents.metadata, &policy);
  // Validates the sizes before they determine how much memory is allocated.
  if (status.ok()) status = policy.config.Validate();
  if (status.ok()) status = policy.action_space.Validate();
  if (status.ok()) status = TakeTensors(contents, &policy);
  if (status.ok()) status = policy.Validate();
  if (!status.ok()) return status;
  return policy;
}

absl::StatusOr<Policy> ReadPolicyFile(const std::string& path) {
  const auto bytes = ReadSafetensorsFile(path);
  if (!bytes.ok()) return Annotate(bytes.status(), path);
  absl::StatusOr<Policy> policy = ParsePolicyFile(*bytes);
  if (!policy.ok()) return Annotate(policy.status(), path);
  return policy;
}

absl::StatusOr<std::string> FormatPolicyFile(const Policy& policy) {
  RETURN_IF_ERROR(policy.Validate());
  Safetensors contents{.metadata = FormatPolicyMetadata(policy), .tensors = {}};
  Weights weights = policy.weights;
  for (const TensorSlot& slot : TensorSlots(policy.config, policy.observation_size(),
                                            policy.action_space.size(), &weights)) {
    std::visit([&](auto* tensor) { contents.tensors[slot.name] = std::move(*tensor); },
               slot.tensor);
  }
  return FormatSafetensors(contents);
}

absl::Status WritePolicyFile(const Policy& policy, const std::string& path) {
  const auto bytes = FormatPolicyFile(policy);
  if (!bytes.ok()) return Annotate(bytes.status(), path);
  return WriteFileAtomically(path, {*bytes});
}

}  // namespace spikeserve
