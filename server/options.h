// How a server is asked to run.
#ifndef SERVER_OPTIONS_H_
#define SERVER_OPTIONS_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "absl/time/time.h"
#include "server/access/tls.h"

namespace spikeserve {

struct ServerOptions {
  std::string policies;                    // DIR of DIR/<policy>/<version>/policy.safetensors
  std::string listen = "127.0.0.1:50051";  // gRPC; port 0 picks one
  std::string http_listen =
      "127.0.0.1:9464";          // metrics, status page; port 0 picks one; empty: none
  absl::Duration poll_policies;  // how often to look for changed policies; 0: only when asked to
  std::string policy_settings;   // file that keeps what operators set; empty: until the end
  absl::Duration session_ttl = absl::Minutes(10);
  absl::Duration compact_after = absl::Seconds(10);  // idle sessions shrink to their history
  int64_t max_sessions = 100'000;
  int64_t max_message_bytes = 4 << 20;  // of one request over gRPC, whoever sends it
  std::string record_dir;  // where sessions that ask for it are recorded; empty: nowhere
  absl::Duration drain_timeout = absl::Seconds(30);

  TlsFiles tls;  // for gRPC and HTTP
  std::string
      tokens;  // file of bearer tokens, see token_file.h; empty: everybody may do everything
  bool insecure_network = false;  // serve others than this machine without the two above

  // INVALID_ARGUMENT names the flag, what was expected and what came.
  absl::Status Validate() const;
};

}  // namespace spikeserve

#endif  // SERVER_OPTIONS_H_
