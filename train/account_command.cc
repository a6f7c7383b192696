#include <array>
#include <cstdint>
#include <cstdio>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/engine/account.h"
#include "core/model/policy.h"
#include "nlohmann/json.hpp"
#include "train/commands.h"
#include "train/decided_episodes.h"
#include "train/evaluation/evaluation.h"

namespace spikeserve {
namespace {

// What one decision costs. Counts and bytes are means.
struct DecisionCost {
  std::array<PricedOperation, kPricedOperations> operations;
  std::array<PricedTraffic, kPricedTraffics> traffic;

  // In nanojoules: by int_45nm, the same with adders as wide as the accumulators, and what memory
  // adds in int_sram_45nm.
  double operations_energy() const;
  double wide_operations_energy() const;
  double traffic_energy() const;
};

struct EnergyAccount {
  std::string environment;
  uint64_t decisions = 0;
  DecisionCost policy;
  // A dense policy in integers. If it was not played, it has the sizes of the policy, a full
  // window, three new tokens and no zero among its activations.
  DecisionCost dense;
  bool dense_was_played = false;
};

constexpr double kNanojoulesPerPicojoule = 1e-3;

DecisionCost CostOf(const Counts& counts, double decisions, const ModelConfig& config) {
  DecisionCost cost = {OperationsOf(counts, config), TrafficOf(counts, config)};
  for (PricedOperation& operation : cost.operations) operation.count /= decisions;
  for (PricedTraffic& traffic : cost.traffic) traffic.bytes /= decisions;
  return cost;
}

nlohmann::ordered_json ToJson(const DecisionCost& cost) {
  nlohmann::ordered_json json;
  for (const PricedOperation& operation : cost.operations) {
    json["operations"][std::string(operation.name)] = {
        {"count", operation.count},
        {"picojoules", operation.price},
        {"picojoules_with_wide_adders", operation.wide_price}};
  }
  for (const PricedTraffic& traffic : cost.traffic) {
    json["memory"][std::string(traffic.name)] = {{"bytes", traffic.bytes},
                                                 {"bytes_of_memory", traffic.memory},
                                                 {"picojoules_per_byte", traffic.price}};
  }
  json["nanojoules"] = {{"int_45nm", cost.operations_energy()},
                        {"int_45nm_with_wide_adders", cost.wide_operations_energy()},
                        {"int_sram_45nm", cost.operations_energy() + cost.traffic_energy()}};
  return json;
}

void AppendOperations(const EnergyAccount& account, std::string* text) {
  absl::StrAppendFormat(text, "%-26s %28s %28s\n%-26s %10s %8s %8s %10s %8s %8s\n", "", "policy",
                        "dense policy", "operation", "count", "pJ each", "nJ", "count", "pJ each",
                        "nJ");
  for (int i = 0; i < kPricedOperations; ++i) {
    const PricedOperation& policy = account.policy.operations[i];
    const PricedOperation& dense = account.dense.operations[i];
    if (policy.count == 0.0 && dense.count == 0.0) continue;
    absl::StrAppendFormat(text, "%-26s %10.1f %8.2f %8.2f %10.1f %8.2f %8.2f\n", policy.name,
                          policy.count, policy.price,
                          kNanojoulesPerPicojoule * policy.count * policy.price, dense.count,
                          dense.price, kNanojoulesPerPicojoule * dense.count * dense.price);
  }
}

void AppendTraffic(const EnergyAccount& account, std::string* text) {
  absl::StrAppendFormat(text, "%-26s %10s %8s %8s %10s %8s %8s\n", "memory", "bytes", "pJ each",
                        "nJ", "bytes", "pJ each", "nJ");
  for (int i = 0; i < kPricedTraffics; ++i) {
    const PricedTraffic& policy = account.policy.traffic[i];
    const PricedTraffic& dense = account.dense.traffic[i];
    absl::StrAppendFormat(text, "%-26s %10.1f %8.2f %8.2f %10.1f %8.2f %8.2f\n", policy.name,
                          policy.bytes, policy.price,
                          kNanojoulesPerPicojoule * policy.bytes * policy.price, dense.bytes,
                          dense.price, kNanojoulesPerPicojoule * dense.bytes * dense.price);
  }
}

void AppendSum(absl::string_view name, double policy, double dense, std::string* text) {
  const bool dense_costs_more = dense >= policy;
  absl::StrAppendFormat(text, "%-35s %10.2f nJ %25.2f nJ; %s costs %.1f times as much\n", name,
                        policy, dense, dense_costs_more ? "the dense one" : "the policy",
                        dense_costs_more ? dense / policy : policy / dense);
}

double DecisionCost::operations_energy() const {
  double sum = 0.0;
  for (const PricedOperation& operation : operations) sum += operation.count * operation.price;
  return kNanojoulesPerPicojoule * sum;
}

double DecisionCost::wide_operations_energy() const {
  double sum = 0.0;
  for (const PricedOperation& operation : operations) sum += operation.count * operation.wide_price;
  return kNanojoulesPerPicojoule * sum;
}

double DecisionCost::traffic_energy() const {
  double sum = 0.0;
  for (const PricedTraffic& part : traffic) sum += part.bytes * part.price;
  return kNanojoulesPerPicojoule * sum;
}

// Returns the account of what was evaluated. INVALID_ARGUMENT for a policy in float32.
absl::StatusOr<EnergyAccount> AccountOf(const Policy& policy, const Evaluation& evaluation) {
  const ModelConfig& config = policy.config;
  if (!config.is_integer()) {
    return InvalidArgument("arithmetic", "integer", "float32");
  }
  const Counts dense = DenseBaselineCounts(config, config.state_inputs(policy.observation_size()),
                                           policy.action_space.size());
  return EnergyAccount{
      .environment = evaluation.environment,
      .decisions = evaluation.decisions,
      .policy = CostOf(evaluation.counts, static_cast<double>(evaluation.decisions), config),
      .dense = CostOf(dense, 1.0, DenseBaseline(config))};
}

// Replaces the dense policy by one that was evaluated. INVALID_ARGUMENT for a spiking policy, one
// in float32, or one for another environment.
absl::Status SetDense(const Policy& dense, const Evaluation& evaluation, EnergyAccount* account) {
  const ModelConfig& config = dense.config;
  if (!config.is_dense() || !config.is_integer()) {
    return InvalidArgument("policy", "mode dense in integer",
                           absl::StrCat("mode ", std::string(ToString(config.mode)), " in ",
                                        std::string(ToString(config.arithmetic))));
  }
  if (evaluation.environment != account->environment) {
    return InvalidArgument("policy", absl::StrCat("one for ", account->environment),
                           absl::StrCat("one for ", evaluation.environment));
  }
  account->dense = CostOf(evaluation.counts, static_cast<double>(evaluation.decisions), config);
  account->dense_was_played = true;
  return absl::OkStatus();
}

nlohmann::ordered_json ToJson(const EnergyAccount& account) {
  return {{"environment", account.environment},
          {"decisions", account.decisions},
          {"policy", ToJson(account.policy)},
          {"dense", ToJson(account.dense)},
          {"dense_was_played", account.dense_was_played}};
}

// Formats the account as tables for the terminal.
std::string ToText(const EnergyAccount& account) {
  std::string text = absl::StrFormat(
      "%s, mean of %d decisions; the dense policy %s\n", account.environment, account.decisions,
      account.dense_was_played ? "was played" : "by its sizes, at a full window");
  AppendOperations(account, &text);
  AppendTraffic(account, &text);
  const DecisionCost& policy = account.policy;
  const DecisionCost& dense = account.dense;
  AppendSum("int_sram_45nm", policy.operations_energy() + policy.traffic_energy(),
            dense.operations_energy() + dense.traffic_energy(), &text);
  AppendSum("int_45nm", policy.operations_energy(), dense.operations_energy(), &text);
  AppendSum("int_45nm with wide adders", policy.wide_operations_energy(),
            dense.wide_operations_energy(), &text);
  return text;
}

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
