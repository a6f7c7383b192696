// Measures how often the intervals of `spiketrain ope` contain the return that a version then has:
// on four tasks, for pairs of a shipped policy and the same policy with a disturbed action head or
// at another temperature. Adds a row to --out for each pair that it does not have yet, and prints
// the table of all rows.
//
//   ope_coverage --out=lab/evidence/ope.csv
#include <CLI/CLI.hpp>
#include <array>
#include <cmath>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <map>
#include <memory>
#include <set>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "absl/algorithm/container.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_split.h"
#include "core/agent/agent_session.h"
#include "core/agent/episode_recorder.h"
#include "core/base/status_macros.h"
#include "core/engine/factory/engine_factory.h"
#include "core/environment/environment.h"
#include "core/math/counter_random.h"
#include "core/model/policy_file.h"
#include "core/session/session_value.h"
#include "train/evaluation/off_policy_episodes.h"
#include "train/evaluation/paired_evaluation.h"

namespace spikeserve {
namespace {

struct Task {
  const char* policy;
  float temperature;  // of the version that is recorded
  // The largest changes: of the logarithm of the temperature, and of the head, relative to it.
  double largest_temperature;
  double largest_head;
};

constexpr std::array<Task, 4> kTasks = {{{"cartpole", 3.0f, 0.3, 0.6},
                                         {"mountaincar", 1.7f, 0.12, 0.6},
                                         {"acrobot", 3.0f, 0.12, 0.6},
                                         {"pendulum", 0.5f, 0.05, 0.25}}};

struct Flags {
  std::string out;
  std::string policies = "deploy/policies";
  std::vector<std::string> tasks;
  int pairs = 30;
  int episodes = 300;
  int truth = 1500;
};

struct Version {
  std::shared_ptr<const ServedPolicy> served;
  float temperature = 1.0f;
};

Version Serve(Policy policy, float temperature) {
  auto served = std::make_shared<ServedPolicy>();
  auto shared = std::make_shared<const Policy>(std::move(policy));
  served->name = "policy";
  served->version = 1;
  served->engine = MakeEngine(shared);
  served->heads = std::make_shared<TenantHeads>(std::move(shared));
  served->observer = std::make_shared<SessionObserver>();
  return {std::move(served), temperature};
}

// Plays one episode in a session of its own, and returns its return.
absl::StatusOr<double> Play(const Version& version, Environment& environment, uint64_t seed,
                            std::vector<Dataset>* recorded) {
  static const SteadyClock clock;
  SessionOptions options;
  options.policy = "policy";
  options.version = 1;
  options.target_return = static_cast<double>(version.served->policy().target_return);
  options.seed = seed;
  options.action_selection = {.sample = true, .temperature = version.temperature};
  AgentSession agent(version.served, NewSession("id", std::move(options)), &clock);
  if (recorded != nullptr) {
    agent.AddListener(std::make_shared<EpisodeRecorder>(version.served, [&](Dataset dataset) {
      recorded->push_back(std::move(dataset));
      return nullptr;
    }));
  }
  StepResult result = {.observation = environment.Reset(seed)};
  double sum = 0.0;
  while (!result.done()) {
    ASSIGN_OR_RETURN(const Answer* answer,
                     agent.Act(std::nullopt, result.observation, result.reward));
    const Action action = answer->action;
    agent.AppendPendingAction();
    result = environment.Step(action);
    sum += result.reward;
  }
  RETURN_IF_ERROR(agent
                      .EndEpisode({.reward = result.reward,
                                   .terminated = result.terminated,
                                   .truncated = result.truncated})
                      .status());
  return sum;
}

absl::StatusOr<std::vector<double>> PlayMany(const Version& version, int episodes, uint64_t key,
                                             std::vector<Dataset>* recorded = nullptr) {
  ASSIGN_OR_RETURN(const auto environment, MakeEnvironment(version.served->policy().environment));
  std::vector<double> returns;
  for (int i = 0; i < episodes; ++i) {
    // Gymnasium's seeds are those of NumPy; 2^40 of them are enough.
    const uint64_t seed = RandomBits({key, static_cast<uint64_t>(i)}) >> 24;
    ASSIGN_OR_RETURN(const double value, Play(version, *environment, seed, recorded));
    returns.push_back(value);
  }
  return returns;
}

// Returns the version of a pair: at another temperature for even pairs, with another head
// otherwise.
Version Change(const Policy& policy, const Task& task, int pair, uint64_t key) {
  Policy changed = policy;
  const double part = (1 + pair / 2 % 15) / 15.0;
  if (pair % 2 == 0) {
    const double sign = pair % 4 == 0 ? 1.0 : -1.0;
    const auto temperature =
        static_cast<float>(task.temperature * std::exp(sign * part * task.largest_temperature));
    return Serve(std::move(changed), temperature);
  }
  std::vector<float>& weights = changed.weights.head.weight.values;
  double square = 0.0;
  for (const float weight : weights) square += static_cast<double>(weight) * weight;
  const double scale =
      part * task.largest_head * std::sqrt(3.0 * square / static_cast<double>(weights.size()));
  for (size_t i = 0; i < weights.size(); ++i) {
    weights[i] += static_cast<float>(scale * (2.0 * UniformDouble(RandomBits({key, i})) - 1.0));
  }
  return Serve(std::move(changed), task.temperature);
}

uint64_t TruthKey(size_t task) { return RandomBits({task, 1'000'000}); }

using Row = std::map<std::string, double>;
constexpr std::array<const char*, 18> kColumns = {"pair",
                                                  "known_new",
                                                  "known_new_error",
                                                  "known_difference",
                                                  "known_difference_error",
                                                  "recorded",
                                                  "effective",
                                                  "can_tell",
                                                  "robust",
                                                  "robust_low",
                                                  "robust_high",
                                                  "difference",
                                                  "difference_low",
                                                  "difference_high",
                                                  "sampling",
                                                  "sampling_low",
                                                  "sampling_high",
                                                  "sampling_difference"};

absl::StatusOr<Row> MeasurePair(const Flags& flags, const Policy& policy, size_t number, int pair,
                                const std::vector<double>& known) {
  const Task& task = kTasks[number];
  const auto key = [&](uint64_t what) {
    return RandomBits({number, static_cast<uint64_t>(pair), what});
  };
  const Version old = Serve(policy, task.temperature);
  const Version fresh = Change(policy, task, pair, key(0));
  std::vector<Dataset> recorded;
  RETURN_IF_ERROR(PlayMany(old, flags.episodes, key(1), &recorded).status());
  // Both versions play the same starts with the same random numbers.
  ASSIGN_OR_RETURN(std::vector<double> truth, PlayMany(fresh, flags.truth, TruthKey(number)));
  const MeanInterval real = MeanWithInterval(truth);
  for (size_t i = 0; i < truth.size(); ++i) truth[i] -= known[i];
  const MeanInterval real_difference = MeanWithInterval(truth);
  ASSIGN_OR_RETURN(const auto decisions,
                   DecideRecorded(recorded, std::make_shared<const Policy>(fresh.served->policy()),
                                  {.temperature = static_cast<double>(fresh.temperature)}));
  const OffPolicyEvaluation result = EvaluateOffPolicy(decisions.episodes);
  const auto& [value, difference] = result.doubly_robust;
  const auto& [sampling, sampling_difference] = result.importance_sampling;
  return Row{{"pair", pair},
             {"known_new", real.mean},
             {"known_new_error", real.high - real.mean},
             {"known_difference", real_difference.mean},
             {"known_difference_error", real_difference.high - real_difference.mean},
             {"recorded", result.recorded_return},
             {"effective", result.effective()},
             {"can_tell", result.can_tell()},
             {"robust", value.value},
             {"robust_low", value.low},
             {"robust_high", value.high},
             {"difference", difference.value},
             {"difference_low", difference.low},
             {"difference_high", difference.high},
             {"sampling", sampling.value},
             {"sampling_low", sampling.low},
             {"sampling_high", sampling.high},
             {"sampling_difference", sampling_difference.value}};
}

using Rows = std::map<std::string, std::vector<Row>>;  // by task

Rows ReadRows(const std::string& path) {
  Rows rows;
  std::ifstream file(path);
  std::string line;
  std::getline(file, line);
  while (std::getline(file, line)) {
    const std::vector<std::string> cells = absl::StrSplit(line, ',');
    Row row;
    for (size_t i = 0; i < kColumns.size(); ++i) row[kColumns[i]] = std::stod(cells.at(i + 1));
    rows[cells[0]].push_back(row);
  }
  return rows;
}

void AppendRow(const std::string& path, const std::string& task, const Row& row) {
  const bool is_new = !std::ifstream(path).good();
  std::ofstream file(path, std::ios::app);
  if (is_new) file << "task," << absl::StrJoin(kColumns, ",") << "\n";
  file << task;
  for (const char* column : kColumns) file << absl::StrFormat(",%.7g", row.at(column));
  file << std::endl;
}

// Whether an estimate and a known value differ by no more than the halves of their intervals allow.
bool Covers(double value, double low, double high, double known, double error) {
  return std::abs(value - known) <= std::hypot((high - low) / 2.0, error);
}

void PrintTable(const Rows& rows) {
  // The sign of a difference is known if its interval has one sign.
  constexpr std::array<const char*, 8> kCounts = {
      "pairs",         "can tell", "return covered", "difference covered", "sampling covered",
      "signs claimed", "known",    "right"};
  std::cout << "| task | " << absl::StrJoin(kCounts, " | ") << " |\n| --- |";
  for (size_t i = 0; i < kCounts.size(); ++i) std::cout << " ---: |";
  std::array<int, kCounts.size()> total = {};
  const auto print = [](const std::string& task, const auto& counts) {
    std::cout << "| " << task << " | " << absl::StrJoin(counts, " | ") << " |\n";
  };
  std::cout << "\n";
  for (const auto& [task, of] : rows) {
    std::array<int, kCounts.size()> n = {};
    for (Row row : of) {
      ++n[0];
      if (row["can_tell"] == 0.0) continue;
      const double error = row["known_new_error"];
      const double known = row["known_difference"], errors = row["known_difference_error"];
      ++n[1];
      n[2] += Covers(row["robust"], row["robust_low"], row["robust_high"], row["known_new"], error);
      n[3] +=
          Covers(row["difference"], row["difference_low"], row["difference_high"], known, errors);
      n[4] += Covers(row["sampling"], row["sampling_low"], row["sampling_high"], row["known_new"],
                     error);
      if (row["difference_low"] <= 0.0 && row["difference_high"] >= 0.0) continue;
      ++n[5];
      if (std::abs(known) <= errors) continue;
      ++n[6];
      n[7] += (row["difference"] > 0.0) == (known > 0.0);
    }
    for (size_t i = 0; i < n.size(); ++i) total[i] += n[i];
    print(task, n);
  }
  print("all", total);
}

absl::Status Measure(const Flags& flags) {
  for (size_t number = 0; number < kTasks.size(); ++number) {
    const Task& task = kTasks[number];
    if (!flags.tasks.empty() && !absl::c_linear_search(flags.tasks, task.policy)) continue;
    std::set<int> done;
    Rows rows = ReadRows(flags.out);
    for (Row& row : rows[task.policy]) done.insert(static_cast<int>(row["pair"]));
    if (std::ssize(done) >= flags.pairs) continue;
    const std::string file =
        absl::StrCat(flags.policies, "/", task.policy, "/1/policy.safetensors");
    ASSIGN_OR_RETURN(const Policy policy, ReadPolicyFile(file));
    ASSIGN_OR_RETURN(const auto known,
                     PlayMany(Serve(policy, task.temperature), flags.truth, TruthKey(number)));
    for (int pair = 0; pair < flags.pairs; ++pair) {
      if (done.contains(pair)) continue;
      ASSIGN_OR_RETURN(const Row row, MeasurePair(flags, policy, number, pair, known));
      AppendRow(flags.out, task.policy, row);
    }
  }
  PrintTable(ReadRows(flags.out));
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  CLI::App app("Measures how often the intervals of spiketrain ope contain the known return");
  spikeserve::Flags flags;
  app.add_option("--out", flags.out, "Table in CSV, which is continued")->required();
  app.add_option("--policies", flags.policies, "Directory of the shipped policies");
  app.add_option("--tasks", flags.tasks, "Policies, separated by commas")->delimiter(',');
  app.add_option("--pairs", flags.pairs, "Pairs of each task");
  app.add_option("--episodes", flags.episodes, "Recorded episodes of a pair");
  app.add_option("--truth", flags.truth,
                 "Episodes that the known return of a version is the mean of");
  CLI11_PARSE(app, argc, argv);
  const auto status = spikeserve::Measure(flags);
  if (!status.ok()) std::cerr << status.message() << "\n";
  return status.ok() ? 0 : 1;
}
