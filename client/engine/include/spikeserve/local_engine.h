// The engine on a robot, for its pilot (pilot.h): goes on with the server's session while the
// server is out of reach, bit for bit. A library of its own, spikeserve::local_engine.
//
//   PilotOptions options = {.period = absl::Milliseconds(20), .local = LocalEngine::FromServer()};
//
// Thread-safe.
#pragma once

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "spikeserve/local_policy.h"

namespace spikeserve {

class LocalEngine : public LocalPolicy {
 public:
  // Plays the policy file that the server sends with the session.
  static std::shared_ptr<LocalEngine> FromServer();
  // Plays a policy file, or that of the policy and version of the session below a folder:
  // DIR/<policy>/<version>/policy.safetensors. The file is read by Resume.
  static std::shared_ptr<LocalEngine> FromFile(std::string path);

  // Resume reads the policy unless it was read before. Returns FAILED_PRECONDITION if the server
  // withholds it, or plays another one (SHA-256); NOT_FOUND if there is no such file;
  // INVALID_ARGUMENT or DATA_LOSS if the policy or the value is not valid. Act and EndEpisode
  // return FAILED_PRECONDITION before Resume, and otherwise the errors of the server's Act.

  // Returns the value of the session, with the bytes of the server's ExportSession.
  virtual absl::StatusOr<std::string> Export() = 0;
};

}  // namespace spikeserve
