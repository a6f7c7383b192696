// Between the Open Inference Protocol's tensors and what an agent sends and gets.
//
// Inputs: "observation" FP32 [obs], environment units; "reward" FP32 [1], for the previous action.
// Outputs: "action" INT64 [1], an index, of a Discrete space, or FP32 [size], environment units, of
// a Box; "probabilities" FP32 [n], Discrete spaces only; "return_to_go" FP32 [1]; "spikes" INT64
// [1]. A request whose observation has a batch dimension of 1 in front gets answers that have one.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_INFERENCE_INFERENCE_TENSORS_H_
#define SERVER_INFERENCE_INFERENCE_TENSORS_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/model/policy.h"
#include "inference/grpc_service.pb.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

struct TensorSpec {
  std::string name;
  inference::DataType data_type;
  std::vector<int64_t> shape;  // without a batch dimension
  bool optional = false;
};

std::vector<TensorSpec> InputSpecs(const Policy& policy);
std::vector<TensorSpec> OutputSpecs(const Policy& policy);

// "FP32" and the like.
std::string DataTypeName(inference::DataType type);

struct InferenceInput {
  std::vector<float> observation;
  std::optional<float> reward;
  bool batched = false;  // the observation has a batch dimension of 1
  bool raw = false;      // the tensors came as bytes, so the answer's go as bytes
};

// INVALID_ARGUMENT names the input or field, what was expected and what came. How long the
// observation has to be is left to the session.
absl::StatusOr<InferenceInput> ReadInputs(const inference::ModelInferRequest& request);

// INVALID_ARGUMENT for an output that `request` names and `specs` does not.
absl::Status CheckOutputs(const inference::ModelInferRequest& request,
                          const std::vector<TensorSpec>& specs);

// Adds the outputs that `request` names; all of them where it names none.
void WriteOutputs(const v1::ActResponse& answer, const inference::ModelInferRequest& request,
                  const InferenceInput& input, inference::ModelInferResponse* response);

}  // namespace spikeserve

#endif  // SERVER_INFERENCE_INFERENCE_TENSORS_H_
