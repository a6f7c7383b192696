// spikeserve: serves spiking policies over gRPC.
//
// Prints one line per endpoint on standard output once it serves, logs to standard error, and stops
// gracefully on SIGTERM or SIGINT.
#include <malloc.h>
#include <pthread.h>

#include <csignal>
#include <cstdint>
#include <iostream>
#include <string>
#include <vector>

#include "absl/flags/flag.h"
#include "absl/flags/parse.h"
#include "absl/flags/usage.h"
#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "server/options.h"
#include "server/server.h"

ABSL_FLAG(std::string, policies, "",
          "Directory of the policies to serve: DIR/<policy>/<version>/policy.safetensors");
ABSL_FLAG(std::string, listen, spikeserve::ServerOptions().listen,
          "HOST:PORT for gRPC; port 0 picks a free one");
ABSL_FLAG(std::string, http_listen, spikeserve::ServerOptions().http_listen,
          "HOST:PORT for the status page, /metrics and /healthz; port 0 picks a free one; empty "
          "for none");
ABSL_FLAG(absl::Duration, poll_policies, spikeserve::ServerOptions().poll_policies,
          "How often to look for new, changed and removed files below --policies; 0 for only when "
          "an operator asks");
ABSL_FLAG(std::string, policy_settings, "",
          "JSON file that keeps default versions, labels, traffic, unloaded versions and paused "
          "learning over a restart; empty: they hold until the server ends");
ABSL_FLAG(absl::Duration, session_ttl, spikeserve::ServerOptions().session_ttl,
          "Sessions that nobody used for this long are ended");
ABSL_FLAG(absl::Duration, compact_after, spikeserve::ServerOptions().compact_after,
          "Sessions that nobody used for this long give back what their next decision can rebuild");
ABSL_FLAG(int64_t, max_sessions, spikeserve::ServerOptions().max_sessions,
          "Sessions open at a time");
ABSL_FLAG(int64_t, max_message_bytes, spikeserve::ServerOptions().max_message_bytes,
          "Length of one request over gRPC; a longer one is RESOURCE_EXHAUSTED");
ABSL_FLAG(std::string, record_dir, spikeserve::ServerOptions().record_dir,
          "Directory in which sessions that ask for it are recorded; empty for none");
ABSL_FLAG(absl::Duration, drain_timeout, spikeserve::ServerOptions().drain_timeout,
          "How long calls in flight may take to end when the server stops");

ABSL_FLAG(std::string, tls_certificate, "",
          "PEM file of the server's certificate chain; empty for plain text");
ABSL_FLAG(std::string, tls_key, "", "PEM file of the certificate's private key");
ABSL_FLAG(std::string, tls_client_ca, "",
          "PEM file of the authorities whose certificates clients must show; empty for none");
ABSL_FLAG(std::string, tokens, "",
          "JSON file of bearer tokens, their tenants, roles and limits; empty: everybody may do "
          "everything");
ABSL_FLAG(bool, insecure_network, false,
          "Serve addresses that others can reach without TLS or without tokens: whoever reaches "
          "them can read, steer and administer everything");

namespace spikeserve {
namespace {

absl::Status Run(const std::vector<char*>& arguments) {
  if (arguments.size() > 1) {
    return absl::InvalidArgumentError(
        absl::StrCat("expected flags alone, received \"", arguments[1], "\""));
  }
  ServerOptions options;
  options.policies = absl::GetFlag(FLAGS_policies);
  options.listen = absl::GetFlag(FLAGS_listen);
  options.http_listen = absl::GetFlag(FLAGS_http_listen);
  options.poll_policies = absl::GetFlag(FLAGS_poll_policies);
  options.policy_settings = absl::GetFlag(FLAGS_policy_settings);
  options.session_ttl = absl::GetFlag(FLAGS_session_ttl);
  options.compact_after = absl::GetFlag(FLAGS_compact_after);
  options.max_sessions = absl::GetFlag(FLAGS_max_sessions);
  options.max_message_bytes = absl::GetFlag(FLAGS_max_message_bytes);
  options.record_dir = absl::GetFlag(FLAGS_record_dir);
  options.drain_timeout = absl::GetFlag(FLAGS_drain_timeout);

  options.tls = {.certificate = absl::GetFlag(FLAGS_tls_certificate),
                 .key = absl::GetFlag(FLAGS_tls_key),
                 .client_ca = absl::GetFlag(FLAGS_tls_client_ca)};
  options.tokens = absl::GetFlag(FLAGS_tokens);
  options.insecure_network = absl::GetFlag(FLAGS_insecure_network);
  // Debian builds Abseil with its debug checks, of which this one costs every lock a walk through a
  // graph behind a global lock. The tests keep it.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);

  // A long request's memory stays for the next one, instead of going back to the system and coming
  // again page by page.
  mallopt(M_TRIM_THRESHOLD, 64 << 20);
  mallopt(M_MMAP_THRESHOLD, 32 << 20);

  // Blocked before there are threads, so that every thread inherits it and sigwait alone takes
  // them.
  sigset_t stop_signals;
  sigemptyset(&stop_signals);
  sigaddset(&stop_signals, SIGTERM);
  sigaddset(&stop_signals, SIGINT);
  pthread_sigmask(SIG_BLOCK, &stop_signals, nullptr);

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
  absl::SetProgramUsageMessage("spikeserve --policies=DIR: serves spiking policies over gRPC.");
  const absl::Status status = spikeserve::Run(absl::ParseCommandLine(argc, argv));
  if (status.ok()) return 0;
  std::cerr << "spikeserve: " << status.message() << std::endl;
  return 1;
}
