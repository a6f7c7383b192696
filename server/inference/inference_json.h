// Converts between the bodies of the Open Inference Protocol over HTTP and its messages over gRPC,
// with Triton's extension for binary tensors: a body is a JSON object, and behind it the bytes of
// the tensors whose parameter binary_data_size shows how many.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <cstddef>
#include <optional>
#include <set>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "inference/grpc_service.pb.h"

namespace spikeserve {

// Which outputs a client wants as bytes.
struct BinaryOutputs {
  bool by_default = false;
  std::set<std::string> binary;  // names
  std::set<std::string> json;    // names, which win over `by_default`

  bool Wants(const std::string& name) const;
};

struct HttpInferRequest {
  inference::ModelInferRequest message;  // with raw contents, without the model's name and version
  BinaryOutputs outputs;
};

// Reads the body of .../infer. `json_bytes` is the length of its JSON object, or nothing if that is
// the whole body. Returns INVALID_ARGUMENT that names the field, the expected and the received.
absl::StatusOr<HttpInferRequest> ReadHttpInfer(absl::string_view body,
                                               std::optional<size_t> json_bytes);

struct HttpInferResponse {
  std::string body;
  std::optional<size_t> json_bytes;  // absent if no bytes of tensors follow
};

// Writes the body of the answer. REQUIRES: `message` has raw contents of FP32 and INT64 tensors.
HttpInferResponse WriteHttpInfer(const inference::ModelInferResponse& message,
                                 const BinaryOutputs& outputs);

// Writes the body of the answer about the server, or about a model.
std::string ToHttpBody(const google::protobuf::Message& message);

// Returns {"error": message}.
std::string HttpErrorBody(absl::string_view message);

}  // namespace spikeserve
