// Reads the parameters of a ModelInfer request that describe its sequence: sequence_id (a string,
// or an integer other than 0), sequence_start, sequence_end and sequence_token. A request that
// ends a sequence may have terminated and truncated. One that
// starts a sequence may also have target_return, seed and record; see OpenSessionRequest.
//
// Free functions without shared state; safe to call from many threads.
#pragma once

#include <string>

#include "absl/status/statusor.h"
#include "inference/grpc_service.pb.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

inline constexpr char kSequenceToken[] = "sequence_token";

struct SequenceRequest {
  std::string id;  // as written in messages: 7, or "seven" in quotes
  // The id of the sequence's session: `sequence:<model>:<id>`. 7 and "7" are different sequences.
  std::string session_id;
  bool start = false;
  bool end = false;
  bool terminated = false;  // how the episode ended, only beside `end`; both false: so
  bool truncated = false;
  std::string token;  // that the answer to the start had; empty: none
};

// Returns the sequence of a request, or INVALID_ARGUMENT that names the parameter, the expected and
// the received value.
absl::StatusOr<SequenceRequest> ReadSequence(const inference::ModelInferRequest& request);

// Returns the request that opens the session of a new sequence. Errors: as ReadSequence.
absl::StatusOr<v1::OpenSessionRequest> ReadOpening(const inference::ModelInferRequest& request);

// Parses a version number. Returns 0, the default version, for an empty string, and
// INVALID_ARGUMENT unless the number is positive.
absl::StatusOr<int64_t> ReadVersion(const std::string& version);

}  // namespace spikeserve
