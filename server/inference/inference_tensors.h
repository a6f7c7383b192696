// Converts between tensors of the Open Inference Protocol and the values of a decision.
//
// Inputs:
//   "observation"    FP32 [obs], environment units
//   "reward"         FP32 [1], for the previous action
// Outputs:
//   "action"         Discrete space: INT64 [1], an index. Box: FP32 [size], environment units
//   "probabilities"  FP32 [n], Discrete spaces only
//   "return_to_go"   FP32 [1]
//   "spikes"         INT64 [1]
// If the observation has a leading batch dimension of 1, so have the outputs.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

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

// The tensors that requests of a policy may have, and those of its responses.
std::vector<TensorSpec> InputSpecs(const Policy& policy);
std::vector<TensorSpec> OutputSpecs(const Policy& policy);

// Returns the name of a data type in the protocol: "FP32" or "INT64".
std::string DataTypeName(inference::DataType type);

struct InferenceInput {
  std::vector<float> observation;
  std::optional<float> reward;
  bool batched = false;  // the observation has a batch dimension of 1
  bool raw = false;      // the inputs are raw bytes, so the outputs are too
};

// Reads the inputs of a request. Returns INVALID_ARGUMENT that names the input or field, the
// expected and the received value. Does not check the length of the observation; the session does.
absl::StatusOr<InferenceInput> ReadInputs(const inference::ModelInferRequest& request);

// Returns INVALID_ARGUMENT if `request` names an output that is not in `specs`.
absl::Status CheckOutputs(const inference::ModelInferRequest& request,
                          const std::vector<TensorSpec>& specs);

// Adds the outputs that `request` names to `response`, or all outputs if it names none.
void WriteOutputs(const v1::ActResponse& answer, const inference::ModelInferRequest& request,
                  const InferenceInput& input, inference::ModelInferResponse* response);

}  // namespace spikeserve
