// What a load test is asked to do.
#ifndef LOADTEST_LOAD_OPTIONS_H_
#define LOADTEST_LOAD_OPTIONS_H_

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "spikeserve/channel.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// How requests travel: one Act call each, a stream per caller, or ActBatch calls.
enum class LoadMode { kUnary, kStream, kBatch };

// Parses "unary", "stream" or "batch". INVALID_ARGUMENT reads "expected X, received Y".
absl::StatusOr<LoadMode> ParseLoadMode(absl::string_view name);

// Parses "session", "fleet", or "" for sessions that are frozen. Errors as above.
absl::StatusOr<std::optional<v1::LearningConfig::Scope>> ParseLearningScope(absl::string_view name);

struct LoadOptions {
  SecurityOptions security;
  std::string server = "127.0.0.1:50051";  // HOST:PORT
  LoadMode mode = LoadMode::kUnary;
  int sessions = 64;
  int streams = 8;  // callers at a time, each with a thread and a connection; at most one a session
  absl::Duration duration = absl::Seconds(10);     // no request starts later
  absl::Duration call_timeout = absl::Seconds(5);  // how long any one call but a stream may take
  std::string policy;                              // empty: the first one served
  // Whose head every session learns, sampling its actions; absent: frozen and greedy.
  std::optional<v1::LearningConfig::Scope> learning_scope;
  int episode_steps = 200;  // steps after which a session ends its episode
  int batch_size = 0;       // most requests in a batch; 0: all of a caller's
  absl::Duration pause_after_error = absl::Milliseconds(10);  // of a caller; 0: it floods
  double rate = 0.0;               // requests a second of all callers; 0: closed loop
  double observation_bound = 1.0;  // of the random observations' absolute values
  uint64_t seed = 0;               // of the observations

  // Returns INVALID_ARGUMENT, which names the flag, what was expected and what was received.
  absl::Status Validate() const;
};

}  // namespace spikeserve

#endif  // LOADTEST_LOAD_OPTIONS_H_
