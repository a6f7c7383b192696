// The engine on a robot, for its pilot (pilot.h): goes on with the server's session while the
// server is out of reach, bit for bit. A library of its own, spikeserve::local_engine.
//
//   PilotOptions options = {.period = absl::Milliseconds(20), .local = LocalEngine::FromServer()};
//
// Thread-safe.
#pragma once

#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/types/span.h"
#include "spikeserve/local_policy.h"

namespace spikeserve {

class LocalEngine : public LocalPolicy {
 public:
  // Plays the policy file that the server sends with the session.
  static std::shared_ptr<LocalEngine> FromServer();
  // Plays a policy file, or that of the policy and version of the session below a folder:
  // DIR/<policy>/<version>/policy.safetensors. The file is read by Resume.
  static std::shared_ptr<LocalEngine> FromFile(std::string path);

  ~LocalEngine() override;

  bool NeedsPolicyFile() const override;
  // Reads the policy unless it was read before. Returns FAILED_PRECONDITION if the server withholds
  // it, or plays another one (SHA-256); NOT_FOUND if there is no such file; INVALID_ARGUMENT or
  // DATA_LOSS if the policy or the value is not valid.
  absl::Status Resume(const v1::ExportSessionResponse& exported) override;
  // Errors: FAILED_PRECONDITION before Resume; otherwise those of the server's Act.
  absl::StatusOr<ActionView> Act(int64_t step, absl::Span<const float> observation, double reward,
                                 const std::optional<ActionView>& executed) override;
  absl::Status EndEpisode(const EpisodeOutcome& outcome, const ActionView& executed) override;

  // Returns the value of the session, with the bytes of the server's ExportSession.
  absl::StatusOr<std::string> Export();

 private:
  class Player;

  explicit LocalEngine(std::string path);

  const std::unique_ptr<Player> player_;
};

}  // namespace spikeserve
