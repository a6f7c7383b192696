// The options of a server. Plain data, safe to read from many threads.
#pragma once

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "core/session/durability.h"
#include "server/access/tls_context.h"
#include "server/base/log.h"
#include "server/metrics/metrics.h"
#include "server/policies/policy_settings.h"
#include "server/store/store_options.h"
#include "server/trace/trace_options.h"
#include "server/transport/limits.h"
#include "server/usage/open_usage.h"

namespace spikeserve {

struct ServerOptions {
  std::string listen = "127.0.0.1:50051";  // gRPC: HOST:PORT or unix:PATH; port 0 picks a free one
  std::string datagram_listen;             // UDP: HOST:PORT, as above; empty: no datagrams
  std::string datagram_advertise;  // HOST:PORT that robots send them to; empty: where it listens
  int64_t loops = 0;               // threads that serve connections; 0: one for each core
  TransportLimits transport_limits;
  bool reflection_v1alpha = false;             // serve the old version of reflection, too
  std::string http_listen = "127.0.0.1:9464";  // status page, metrics; port 0 as above; or empty
  std::string http_origins;             // whose web pages may call it, see Origins; empty: none
  int64_t max_message_bytes = 4 << 20;  // of one request over gRPC, from any caller
  absl::Duration drain_timeout = absl::Seconds(30);  // for calls in flight when the server stops

  std::string policies;          // directory of <policy>/<version>/policy.safetensors
  absl::Duration poll_policies;  // interval of looking for changed policies; 0: on request only
  DefaultRule default_version = DefaultRule::kStay;  // unless an operator sets it
  bool withhold_policies = false;                    // never send their files to robots
  bool allow_no_policies = false;                    // start although nothing can be served
  std::string policy_settings;               // file that keeps what operators set; empty: not kept
  std::string audit_log;                     // file that keeps what operators did; empty: not kept
  bool allow_unconfirmed_sequences = false;  // without a token, although servers share sessions
  bool allow_unrecorded_changes = false;     // of operators, if audit_log cannot be written
  std::string trusted_keys;  // file of public keys, see PolicySignatures; empty: none is needed
  std::string signing_key;   // file of the private key of promoted versions; empty: none

  absl::Duration session_ttl = absl::Minutes(10);    // idle time that ends a session
  absl::Duration compact_after = absl::Seconds(10);  // idle time that shrinks one to its history
  int64_t max_sessions = 100'000;                    // open at a time
  // Standard deviations from the mean of the training data beyond which an element of an
  // observation counts as unusual; 0: none does.
  double unusual_deviations = kUnusualDeviations;
  std::string wiring = "count";  // what follows from a verdict about it, see ParseWiringRules
  std::string record_dir;        // where sessions are recorded that ask for it; empty: nowhere
  int64_t max_recorded_bytes = int64_t{64} << 30;  // in `record_dir`; one tenant has half of them
  int64_t max_policy_bytes = int64_t{64} << 30;    // in `policies`, likewise; what is promoted or
                                                   // pushed adds to them
  int64_t max_pushed_versions = 100;               // of a policy
  StoreOptions store;  // where sessions are kept so that they survive the server
  Durability durability = Durability::kAsync;  // of stored sessions that ask for none
  UsageOptions usage;                          // what the ledger tells apart and where it is

  TlsFiles tls;        // for gRPC and HTTP
  std::string tokens;  // file of bearer tokens, see token_file.h; empty: any caller may do anything
  bool share_heads_across_tenants = false;  // the fleet sessions of all tenants learn one head
  bool insecure_network = false;            // serve other machines without TLS or without tokens

  TraceOptions trace;  // where traces go; by default nowhere

  LogFormat log_format = LogFormat::kText;  // of the lines on standard error

  // Returns INVALID_ARGUMENT, which names the flag, what was expected and what was received.
  absl::Status Validate() const;
};

}  // namespace spikeserve
