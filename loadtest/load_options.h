// The options of a load test.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "client/tools/default_server.h"
#include "core/base/enum_names.h"
#include "core/learning/learning_options.h"
#include "core/session/durability.h"
#include "spikeserve/channel.h"

namespace spikeserve {

// How requests are sent: one Act call each, one stream per caller, or ActBatch calls.
enum class LoadMode { kUnary, kStream, kBatch };

constexpr std::array<EnumName<LoadMode>, 3> EnumNames(LoadMode) {
  return {
      {{LoadMode::kUnary, "unary"}, {LoadMode::kStream, "stream"}, {LoadMode::kBatch, "batch"}}};
}

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
  std::optional<Scope> learning_scope;
  std::optional<Durability> durability;  // of every session; absent: the default of the server
  int episode_steps = 200;               // steps after which a session ends its episode
  int batch_size = 0;  // largest number of requests in a batch; 0: all agents of a caller
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
