// The options of a load test.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "absl/time/time.h"
#include "client/tools/default_server.h"
#include "spikeserve/channel.h"
#include "spikeserve/v1/policy_service.pb.h"

namespace spikeserve {

// How requests are sent: one Act call each, one stream per caller, or ActBatch calls.
enum class LoadMode { kUnary, kStream, kBatch };

// Parses "unary", "stream" or "batch". INVALID_ARGUMENT reads "expected X, received Y".
absl::StatusOr<LoadMode> ParseLoadMode(absl::string_view name);

// Parses "none", "async", "sync", or "" for the default of the server. Errors as above.
absl::StatusOr<v1::Durability> ParseDurability(absl::string_view name);

// Parses "session", "fleet", or "" for sessions that do not learn. Errors as above.
absl::StatusOr<std::optional<v1::LearningConfig::Scope>> ParseLearningScope(absl::string_view name);

struct LoadOptions {
  SecurityOptions security;
  std::string server = DefaultServer();  // as Client::Connect takes it
  LoadMode mode = LoadMode::kUnary;
  int sessions = 64;
  // Concurrent callers, each with a thread and a connection; at most one per session.
  int streams = 8;
  absl::Duration duration = absl::Seconds(10);     // requests start within this time
  absl::Duration call_timeout = absl::Seconds(5);  // of one call; a reply on a stream: 4 times this
  std::string policy;                              // empty: the first policy of the server
  // The head that every session learns, with sampled actions; absent: frozen and greedy.
  std::optional<v1::LearningConfig::Scope> learning_scope;
  v1::Durability durability = v1::DURABILITY_DEFAULT;  // of every session
  int episode_steps = 200;  // steps after which a session ends its episode
  int batch_size = 0;       // largest number of requests in a batch; 0: all agents of a caller
  // The pause of a caller after an error; 0: none, so a server that refuses requests is flooded.
  absl::Duration pause_after_error = absl::Milliseconds(10);
  bool retry = false;              // the client repeats failed calls and reopens broken streams
  double rate = 0.0;               // requests per second of all callers; 0: closed loop
  double observation_bound = 1.0;  // largest absolute value of the random observations
  std::string observations;        // file of a RecordedEpisode; empty: random observations
  uint64_t seed = 0;               // of the observations

  // Returns INVALID_ARGUMENT with the flag, the expected and the received value.
  absl::Status Validate() const;
};

}  // namespace spikeserve
