#include "server/command_line.h"

#include <google/protobuf/stubs/logging.h>
#include <malloc.h>
#include <pthread.h>
#include <unistd.h>

#include <csignal>
#include <cstdlib>
#include <iostream>
#include <thread>

#include "absl/base/thread_annotations.h"
#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "core/base/status_macros.h"
#include "core/cli/program.h"
#include "server/base/log.h"
#include "server/options.h"
#include "server/server.h"

namespace spikeserve {
namespace {

void AddConnectionFlags(Command program, ServerOptions* options) {
  TransportLimits* limits = &options->transport_limits;
  program.Flags("Advanced: connections")
      .Add("datagram_listen", "HOST:PORT", &options->datagram_listen,
           "Address of datagrams (UDP), port 0: a free one; empty: none")
      .Add("datagram_advertise", "HOST:PORT", &options->datagram_advertise,
           "Where robots send datagrams; empty: where the server listens")
      .Add("max_streams", "N", &limits->max_streams, "Calls at a time on one connection")
      .Add("max_header_bytes", "BYTES", &limits->max_header_bytes, "Metadata of one call")
      .Add("max_headers", "N", &limits->max_headers, "Headers of one call")
      .Add("max_resets_per_second", "N", &limits->max_resets_per_second,
           "Calls that a connection may cancel")
      .Add("max_control_frames_per_second", "N", &limits->max_control_frames_per_second,
           "Most PING, SETTINGS, PRIORITY and empty frames of a connection")
      .Add("max_connection_bytes", "BYTES", &limits->max_connection_bytes,
           "Requests and answers in flight on one connection")
      .Add("max_tenant_bytes", "BYTES", &limits->max_tenant_bytes,
           "Requests and answers in flight for one tenant")
      .Add("max_bytes_in_flight", "BYTES", &limits->max_bytes_in_flight,
           "Requests and answers in flight for the whole server")
      .Add("max_connections", "N", &limits->max_connections, "Connections at a time")
      .Add("max_connections_per_address", "N", &limits->max_connections_per_address,
           "Connections of one IPv4 address or IPv6 /64")
      .Add("max_connections_per_network", "N", &limits->max_connections_per_network,
           "Connections of one IPv4 /24 or IPv6 /48")
      .Add("max_idle_unauthenticated", "N", &limits->max_idle_unauthenticated,
           "Connections that have made no call yet")
      .Add("max_unauthenticated_bytes", "BYTES", &limits->max_unauthenticated_bytes,
           "Memory of connections and calls without a valid token")
      .Add("first_request_timeout", "DURATION", &limits->first_request_timeout,
           "Time to the first call of a connection")
      .Add("request_timeout", "DURATION", &limits->request_timeout,
           "Time for one message to arrive")
      .Add("idle_timeout", "DURATION", &limits->idle_timeout, "Time without a call")
      .Add("write_timeout", "DURATION", &limits->write_timeout,
           "Time in which a client takes no answers")
      .Add("keepalive_interval", "DURATION", &limits->keepalive_interval,
           "Silence of a client with an open call before a PING")
      .Add("keepalive_timeout", "DURATION", &limits->keepalive_timeout, "Time to answer the PING")
      .Add("max_connection_age", "DURATION", &limits->max_connection_age,
           "Age at which clients are asked to connect again");
}

void AddServingFlags(Command program, ServerOptions* options) {
  program.Flags("Serving")
      .Add("listen", "HOST:PORT", &options->listen,
           "Address of gRPC, or unix:PATH; port 0: a free one")
      .Add("loops", "N", &options->loops, "Threads that serve connections; 0: one for each core")
      .Add("http_listen", "HOST:PORT", &options->http_listen,
           "Status page and /metrics; empty: none")
      .Add("http_origins", "ORIGINS", &options->http_origins,
           "Comma-separated origins that browsers may call from (CORS)")
      .Add("max_message_bytes", "BYTES", &options->max_message_bytes, "Largest gRPC request")
      .Add("drain_timeout", "DURATION", &options->drain_timeout,
           "Time for calls in flight to finish at shutdown")
      .Add("log_format", EnumKind<LogFormat>(), &options->log_format, "Format of the log");
}

void AddSessionFlags(Command program, ServerOptions* options) {
  program.Flags("Policies")
      .Add("policies", "DIR", &options->policies,
           "Policies: DIR/<policy>/<version>/policy.safetensors")
      .Add("poll_policies", "DURATION", &options->poll_policies,
           "Interval of checks for changed policies; 0: never")
      .Add("policy_settings", "FILE", &options->policy_settings,
           "JSON file that stores the settings of operators")
      .Add("audit_log", "FILE", &options->audit_log,
           "File to which the actions of operators are appended");
  program.Flags("Sessions")
      .Add("session_ttl", "DURATION", &options->session_ttl, "Idle time that ends a session")
      .Add("max_sessions", "N", &options->max_sessions, "Largest number of open sessions")
      .Add("record_dir", "DIR", &options->record_dir, "Directory for recorded sessions")
      .Add("max_recorded_bytes", "N", &options->max_recorded_bytes,
           "Most bytes in --record_dir, which tenants divide")
      .Add("session_store", "STORE", &options->store.address,
           "Where sessions survive: memory, file:DIR or redis://HOST");
}

void AddAdvancedFlags(Command program, ServerOptions* options) {
  program.Flags("Advanced: policies, sessions and usage")
      .Add("usage_label", "KEY", &options->usage.label,
           "Label that tells rows of usage apart, such as robot")
      .Add("usage_interval", "DURATION", &options->usage.interval, "Time until usage is booked")
      .Add("usage_dir", "DIR", &options->usage.directory,
           "Where usage is kept without --session_store; empty: in memory")
      .AddSwitch("usage_metrics", &options->usage.tenant_metrics,
                 "Metrics of this month by tenant, of at most 100 tenants")
      .Add("max_policy_bytes", "N", &options->max_policy_bytes,
           "Most bytes of promoted and pushed versions, which tenants divide")
      .Add("max_pushed_versions", "N", &options->max_pushed_versions,
           "Most pushed versions of a policy; the oldest unused make room")
      .AddSwitch("allow_unrecorded_changes", &options->allow_unrecorded_changes,
                 "Let operators change things while --audit_log cannot be written")
      .AddSwitch("withhold_policies", &options->withhold_policies,
                 "Do not send policy files (ExportSession, PullPolicy)")
      .AddSwitch("allow_no_policies", &options->allow_no_policies,
                 "Start although no policy can be served")
      .Add("default_version", EnumKind<DefaultRule>(), &options->default_version,
           "What loading a version does to the default")
      .Add("trusted_keys", "FILE", &options->trusted_keys,
           "PEM public keys; unsigned policies are refused")
      .Add("signing_key", "FILE", &options->signing_key,
           "PEM Ed25519 private key that signs promoted policies")
      .AddSwitch("share_heads_across_tenants", &options->share_heads_across_tenants,
                 "Fleet sessions of all tenants learn one head")
      .AddSwitch("reflection_v1alpha", &options->reflection_v1alpha,
                 "Serve reflection to old clients, too")
      .Add("compact_after", "DURATION", &options->compact_after,
           "Idle time after which a session frees memory")
      .Add("unusual_deviations", "K", &options->unusual_deviations,
           "Distance from the training data that counts as unusual; 0: none")
      .Add("wiring", "RULES", &options->wiring,
           "What follows if a robot looks miswired: count, warn or safe, POLICY=safe for one; by "
           "commas")
      .Add("durability", EnumKind<Durability>(), &options->durability,
           "Durability of stored sessions that name none")
      .Add("store_user", "NAME", &options->store.user,
           "User of Redis; empty: as the address says, or the default user")
      .Add("store_password_file", "FILE", &options->store.password_file, "Password of Redis")
      .Add("store_timeout", "DURATION", &options->store.timeout,
           "Time that Redis may take to answer")
      .Add("store_ca", "FILE", &options->store.tls_files.ca,
           "PEM authorities of Redis over TLS; empty: those of the system")
      .Add("store_certificate", "FILE", &options->store.tls_files.certificate,
           "PEM client certificate for Redis")
      .Add("store_key", "FILE", &options->store.tls_files.key, "PEM private key of the former")
      .Add("store_replicas", "N", &options->store.replicas,
           "Replicas of Redis that must have a record before it counts")
      .AddSwitch("allow_unconfirmed_sequences", &options->allow_unconfirmed_sequences,
                 "Allow Open Inference sequences without sequence_token on a shared store")
      .AddSwitch("store_may_evict", &options->store.may_evict,
                 "Allow SYNC although Redis removes sessions when its memory is full")
      .Add("store_retention", "DURATION", &options->store.retention,
           "Time that the store keeps an unused session");
}

void AddSecurityFlags(Command program, ServerOptions* options) {
  program.Flags("Security")
      .Add("tls_certificate", "FILE", &options->tls.certificate,
           "PEM certificate chain of the server; turns TLS on")
      .Add("tls_key", "FILE", &options->tls.key, "PEM private key of the certificate")
      .Add("tls_client_ca", "FILE", &options->tls.client_ca,
           "PEM authorities of required client certificates")
      .Add("tokens", "FILE", &options->tokens, "JSON file of bearer tokens, roles and limits")
      .AddSwitch("insecure_network", &options->insecure_network,
                 "Serve a network without TLS or without tokens");
}

void AddFlags(Command program, ServerOptions* options) {
  AddServingFlags(program, options);
  AddConnectionFlags(program, options);
  AddSessionFlags(program, options);
  AddAdvancedFlags(program, options);
  AddSecurityFlags(program, options);
}

// Receives SIGTERM and SIGINT on a thread of its own. Before Started(), when nothing is served yet
// and the start may wait for a store that says nothing, they end the process at once.
class StopSignals {
 public:
  // Blocks the signals. Call it before there are other threads, which inherit this.
  StopSignals() {
    sigemptyset(&signals_);
    sigaddset(&signals_, SIGTERM);
    sigaddset(&signals_, SIGINT);
    pthread_sigmask(SIG_BLOCK, &signals_, nullptr);
    std::thread([this] {
      Receive();
    }).detach();  // a thread that waits for a signal cannot be ended
  }

  void Started() {
    absl::MutexLock lock(&mutex_);
    started_ = true;
  }
  // Returns after a signal.
  void Wait() {
    absl::MutexLock lock(&mutex_);
    mutex_.Await(absl::Condition(&received_));
  }

 private:
  void Receive() {
    int signal = 0;
    sigwait(&signals_, &signal);
    absl::MutexLock lock(&mutex_);
    if (!started_) {
      LogInfo("stopped before it served");
      _exit(EXIT_SUCCESS);
    }
    received_ = true;
  }

  sigset_t signals_;
  absl::Mutex mutex_;
  bool started_ ABSL_GUARDED_BY(mutex_) = false;
  bool received_ ABSL_GUARDED_BY(mutex_) = false;
};

// Serves until SIGTERM or SIGINT.
absl::Status Serve(const ServerOptions& options) {
  // Debian builds Abseil with this check, which takes a global lock for every lock. The tests keep
  // it.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);

  // Protobuf would write a line, with bytes of the client's choice, for each unreadable message.
  google::protobuf::SetLogHandler(nullptr);

  // A long request's memory goes back to the system when it is answered.
  mallopt(M_TRIM_THRESHOLD, 4 << 20);
  mallopt(M_MMAP_THRESHOLD, 1 << 20);

  // OpenSSL writes to sockets without MSG_NOSIGNAL; a client that left must not end the server.
  std::signal(SIGPIPE, SIG_IGN);

  static StopSignals& stop_signals = *new StopSignals;  // its thread uses it until the process ends

  // A file that exceeds the limit of the process is an error of the call that wrote it.
  signal(SIGXFSZ, SIG_IGN);

  SetLogFormat(options.log_format);
  ASSIGN_OR_RETURN(const auto server, Server::Start(options));
  stop_signals.Started();
  std::cout << "spikeserve: serving gRPC on " << server->grpc_address() << std::endl;
  if (!options.http_listen.empty()) {
    std::cout << "spikeserve: serving HTTP on " << server->http_address() << std::endl;
  }
  if (!options.datagram_listen.empty()) {
    std::cout << "spikeserve: serving datagrams on " << server->datagram_address() << std::endl;
  }
  stop_signals.Wait();
  server->Stop();
  return absl::OkStatus();
}

}  // namespace

int RunServer(int argc, char** argv) {
  ServerOptions options;
  Program program("spikeserve", "Serves Spiking Decision Transformers to agents over gRPC");
  AddFlags(program.root(), &options);
  for (const char* of_clients : {"SPIKESERVE_TOKEN", "SPIKESERVE_SERVER"}) {
    program.AllowVariable(of_clients);
  }
  program.root().SetAction([&options] {
    auto trace = ReadTraceOptions(
        // NOLINTNEXTLINE(concurrency-mt-unsafe): nothing changes the environment.
        [](const std::string& name) { return std::getenv(name.c_str()); });
    if (!trace.ok()) return trace.status();
    options.trace = *std::move(trace);
    return Serve(options);
  });
  return program.Run(argc, argv);
}

}  // namespace spikeserve
