// Where traces go, and of which requests there are some: the standard environment variables of
// OpenTelemetry, OTEL_*. docs/tracing.md lists them.
//
// Plain data and a free function; safe to use from many threads.
#pragma once

#include <cstddef>
#include <string>
#include <utility>
#include <vector>

#include "absl/functional/function_ref.h"
#include "absl/status/statusor.h"
#include "absl/time/time.h"

namespace spikeserve {

struct TraceOptions {
  using Pairs = std::vector<std::pair<std::string, std::string>>;

  // The collector. Empty: there are no traces.
  std::string host;
  int port = 4317;
  bool tls = false;
  std::string ca;           // file of PEM authorities of the collector; empty: those of the system
  std::string certificate;  // PEM file for the collector; empty: none
  std::string key;          // PEM file of its key
  Pairs headers;            // sent with each batch; names in lower case
  absl::Duration timeout = absl::Seconds(10);  // of one batch

  // Describes this process.
  std::string service_name = "spikeserve";
  Pairs resource;  // further attributes

  // Decides about requests whose caller has not: the share of them that is sampled, 0 to 1.
  double ratio = 1.0;
  // Follows the decision of a caller. False: `ratio` decides about all requests.
  bool follows_parent = true;
  // Takes over the trace of a caller. False: each request begins a trace of its own.
  bool reads_parent = true;

  // The buffer of spans that wait to be sent.
  size_t queue = 2048;
  size_t batch = 512;
  absl::Duration delay = absl::Seconds(5);  // until a batch that is not full is sent

  std::string store_system;  // `db.system.name` of the session store; empty: unknown

  bool enabled() const { return !host.empty(); }
};

// Returns the options that the environment names; `get` returns the value of a variable, or null.
// An empty variable counts as one that is not set. Without an endpoint there are no traces, and the
// other variables, which may be meant for other programs, are not looked at. INVALID_ARGUMENT names
// the variable, what was expected and what was received.
absl::StatusOr<TraceOptions> ReadTraceOptions(
    absl::FunctionRef<const char*(const std::string& name)> get);

}  // namespace spikeserve
