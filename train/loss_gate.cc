#include "train/loss_gate.h"

#include "core/base/status.h"

namespace spikeserve {

void LossGate::AddTo(FlagGroup flags) {
  flags
      .Add("max_loss", "SHARE", &max_loss,
           "Share of the return, or of agreement, that integers may lose")
      .AddSwitch("allow_loss", &allow_loss, "Write a policy that lost more");
}

absl::Status LossGate::Validate() const {
  if (max_loss >= 0.0 && max_loss <= 1.0) return absl::OkStatus();
  return InvalidArgument("--max_loss", "0 to 1", max_loss);
}

absl::Status LossGate::Check(const RoundingLoss& loss, absl::string_view advice) const {
  return allow_loss ? absl::OkStatus() : CheckLoss(loss, max_loss, advice);
}

}  // namespace spikeserve
