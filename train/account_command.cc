#include <cstdio>
#include <memory>
#include <string>

#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "train/commands.h"
#include "train/decided_episodes.h"
#include "train/evaluation/energy_account.h"

namespace spikeserve {
namespace {

struct AccountFlags {
  std::string policy;
  std::string dense;  // empty: computed from the sizes
  DecidedEpisodesFlags episodes;
  bool json = false;
};

// Replaces the dense policy of the account by that of --dense.
absl::Status PlayDense(const AccountFlags& flags, EnergyAccount* account) {
  ASSIGN_OR_RETURN(const auto dense, ReadRequiredPolicy(flags.dense));
  ASSIGN_OR_RETURN(const Evaluation evaluation, Decide(flags.episodes, dense));
  return SetDense(*dense, evaluation, account);
}

absl::Status Account(const AccountFlags& flags) {
  ASSIGN_OR_RETURN(const auto policy, ReadRequiredPolicy(flags.policy));
  ASSIGN_OR_RETURN(const Evaluation evaluation, Decide(flags.episodes, policy));
  absl::StatusOr<EnergyAccount> account = AccountOf(*policy, evaluation);
  if (!account.ok()) return Annotate(account.status(), "--policy");
  if (!flags.dense.empty()) {
    absl::Status status = PlayDense(flags, &*account);
    if (!status.ok()) return Annotate(status, "--dense");
  }
  std::fputs((flags.json ? ToJson(*account).dump(2) + "\n" : ToText(*account)).c_str(), stdout);
  return absl::OkStatus();
}

}  // namespace

void AddAccountCommand(Program& program) {
  const Command command = program.root().AddCommand(
      "account", "Prices every operation of an integer policy and its dense baseline");
  const auto flags = std::make_shared<AccountFlags>();
  constexpr char kPolicy[] = "Policy";
  command.Flags(kPolicy)
      .Add("policy", "FILE", &flags->policy, "Policy file")
      .Add("dense", "FILE", &flags->dense,
           "Dense policy in integers; default: one of the same sizes, unplayed");
  flags->episodes.AddTo(command, kPolicy);
  command.Flags(kPolicy).AddSwitch("json", &flags->json, "Print one JSON object instead of text");
  command.SetAction([flags] { return Account(*flags); });
}

}  // namespace spikeserve
