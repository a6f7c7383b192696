// spikeserve: serves spiking policies over gRPC.
//
// Prints one line per endpoint on standard output once it serves, logs to standard error, and stops
// gracefully on SIGTERM or SIGINT.
#include <malloc.h>
#include <pthread.h>

#include <csignal>
#include <iostream>

#include "absl/status/status.h"
#include "absl/synchronization/mutex.h"
#include "core/cli/program.h"
#include "server/options.h"
#include "server/server.h"

namespace spikeserve {
namespace {

void AddFlags(Command program, ServerOptions* options) {
  program.Flags("Serving")
      .Add("listen", "HOST:PORT", &options->listen, "Address of gRPC; port 0 picks a free one")
      .Add("http_listen", "HOST:PORT", &options->http_listen,
           "Status page and /metrics; empty: none")
      .Add("max_message_bytes", "BYTES", &options->max_message_bytes, "Largest gRPC request")
      .Add("drain_timeout", "DURATION", &options->drain_timeout,
           "Time for calls in flight to finish at shutdown")
      .Add("log_format", EnumKind<LogFormat>(), &options->log_format, "Format of the log");
  program.Flags("Policies")
      .Add("policies", "DIR", &options->policies,
           "Policies: DIR/<policy>/<version>/policy.safetensors")
      .Add("poll_policies", "DURATION", &options->poll_policies,
           "Interval of checks for changed policies; 0: never")
      .Add("policy_settings", "FILE", &options->policy_settings,
           "JSON file that stores the settings of operators");
  program.Flags("Sessions")
      .Add("session_ttl", "DURATION", &options->session_ttl, "Idle time that ends a session")
      .Add("compact_after", "DURATION", &options->compact_after,
           "Idle time after which a session frees memory")
      .Add("max_sessions", "N", &options->max_sessions, "Largest number of open sessions")
      .Add("record_dir", "DIR", &options->record_dir, "Directory for recorded sessions");
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

// Serves until SIGTERM or SIGINT.
absl::Status Serve(const ServerOptions& options) {
  // Debian builds Abseil with this check, which takes a global lock for every lock. The tests keep
  // it.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);

  // Keeps the memory of a long request for the next one instead of returning it to the system.
  mallopt(M_TRIM_THRESHOLD, 64 << 20);
  mallopt(M_MMAP_THRESHOLD, 32 << 20);

  // Blocks the signals before there are threads, which inherit this; only sigwait receives them.
  sigset_t stop_signals;
  sigemptyset(&stop_signals);
  sigaddset(&stop_signals, SIGTERM);
  sigaddset(&stop_signals, SIGINT);
  pthread_sigmask(SIG_BLOCK, &stop_signals, nullptr);

  SetLogFormat(options.log_format);
  const auto server = Server::Start(options);
  if (!server.ok()) return server.status();
  std::cout << "spikeserve: serving gRPC on " << (*server)->grpc_address() << std::endl;
  if (!options.http_listen.empty()) {
    std::cout << "spikeserve: serving HTTP on " << (*server)->http_address() << std::endl;
  }
  int signal = 0;
  sigwait(&stop_signals, &signal);
  (*server)->Stop();
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  spikeserve::ServerOptions options;
  spikeserve::Program program("spikeserve",
                              "Serves Spiking Decision Transformers to agents over gRPC");
  spikeserve::AddFlags(program.root(), &options);
  program.root().SetAction([&options] { return spikeserve::Serve(options); });
  return program.Run(argc, argv);
}
