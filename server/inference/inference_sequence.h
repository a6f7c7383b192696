// What the parameters of a ModelInfer request say about its sequence: sequence_id (a string, or an
// integer other than 0), sequence_start and sequence_end; and, where one starts, target_return,
// seed and record, as OpenSession has them.
//
// Free functions without shared state; safe to call from many threads.
#ifndef SERVER_INFERENCE_INFERENCE_SEQUENCE_H_
#define SERVER_INFERENCE_INFERENCE_SEQUENCE_H_

#include <string>

#include "absl/status/statusor.h"
#include "inference/grpc_service.pb.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

struct SequenceRequest {
  std::string id;  // for messages: 7, or "seven" in quotes
  // Of the session behind it, `sequence:<model>:<id>`. 7 and "7" are two sequences.
  std::string session_id;
  bool start = false;
  bool end = false;
};

// INVALID_ARGUMENT names the parameter, what was expected and what came.
absl::StatusOr<SequenceRequest> ReadSequence(const inference::ModelInferRequest& request);

// What opens the session of a sequence that starts.
absl::StatusOr<v1::OpenSessionRequest> ReadOpening(const inference::ModelInferRequest& request);

// An empty version is 0, the default.
absl::StatusOr<int64_t> ReadVersion(const std::string& version);

}  // namespace spikeserve

#endif  // SERVER_INFERENCE_INFERENCE_SEQUENCE_H_
