#include "lab/report/report_runs.h"

#include <chrono>
#include <filesystem>
#include <fstream>
#include <map>
#include <memory>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/file.h"
#include "core/base/status_macros.h"
#include "core/model/policy_file.h"
#include "train/evaluation/evaluation.h"
#include "train/recording/record.h"
#include "train/trainer/initial_policy.h"
#include "train/trainer/trainer.h"

namespace spikeserve {
namespace {

using Json = nlohmann::ordered_json;

constexpr uint64_t kFirstUnseenSeed = 2'000'000;
constexpr int kValidations = 20;  // points of a run's loss curve

Json ResultToJson(const ReportResult& result) {
  Json losses = Json::array();
  for (const LossPoint& point : result.losses) losses.push_back({point.iteration, point.loss});
  return {{"run", result.run.name()},
          {"command", result.command},
          {"losses", std::move(losses)},
          {"evaluation", result.evaluation},
          {"returns", result.returns},
          {"omega", result.omega},
          {"phi", result.phi},
          {"spikes", result.insight.spikes},
          {"gates", result.insight.gates},
          {"seconds_per_decision", result.seconds_per_decision}};
}

// Throws Json::exception if a field is missing or has another type.
ReportResult FromJson(const Json& json, const ReportRun& run) {
  ReportResult result;
  result.run = run;
  json.at("command").get_to(result.command);
  for (const Json& point : json.at("losses")) result.losses.push_back({point.at(0), point.at(1)});
  result.evaluation = json.at("evaluation");
  json.at("returns").get_to(result.returns);
  json.at("omega").get_to(result.omega);
  json.at("phi").get_to(result.phi);
  json.at("spikes").get_to(result.insight.spikes);
  json.at("gates").get_to(result.insight.gates);
  json.at("seconds_per_decision").get_to(result.seconds_per_decision);
  return result;
}

// Returns nullopt if the file does not hold a result.
absl::optional<ReportResult> ReadResult(const std::string& path, const ReportRun& run) {
  std::ifstream file(path);
  const Json json = Json::parse(file, nullptr, /*allow_exceptions=*/false);
  if (json.is_discarded()) return absl::nullopt;
  try {
    return FromJson(json, run);
  } catch (const Json::exception&) {
    return absl::nullopt;
  }
}

RecordOptions DataOptions(const ReportOptions& options, const ReportRun& run) {
  RecordOptions data = options.data;
  data.expert.environment = run.environment;
  data.seed = run.seed;
  return data;
}

TrainOptions TrainingOptions(const ReportOptions& options, const ReportRun& run) {
  TrainOptions training = options.training;
  training.seed = run.seed;
  return training;
}

std::string Command(const ReportOptions& options, const ReportRun& run) {
  const ModelConfig& config = run.config;
  return absl::StrCat(
      "spiketrain train --mode=", std::string(ToString(config.mode)), " ",
      DataOptions(options, run).ToFlags(), " ", TrainingOptions(options, run).ToFlags(),
      " --hidden_size=", config.hidden_size, " --heads=", config.heads, " --layers=", config.layers,
      " --ticks=", config.ticks, " --context=", config.context, " --ffn_size=", config.ffn_size,
      " --observation_changes=false --out=", run.name());
}

class Runner {
 public:
  explicit Runner(const ReportOptions& options) : options_(options) {}

  absl::StatusOr<ReportResult> Run(const ReportRun& run,
                                   const std::function<void(const std::string&)>& log) {
    const std::string directory = absl::StrCat(options_.directory, "/", run.name());
    const std::string path = directory + "/result.json";
    if (auto result = ReadResult(path, run)) {
      if (result->command == Command(options_, run)) return *std::move(result);
      return absl::FailedPreconditionError(absl::StrCat(path, ": expected a run of ",
                                                        Command(options_, run),
                                                        ", received one of ", result->command));
    }
    log(run.name());
    std::error_code error;
    std::filesystem::create_directories(directory, error);
    if (error) return absl::UnavailableError(absl::StrCat(directory, ": ", error.message()));
    ReportResult result;
    result.run = run;
    result.command = Command(options_, run);
    ASSIGN_OR_RETURN(Policy policy, Train(run, directory, &result.losses));
    RETURN_IF_ERROR(Play(policy, &result));
    if (auto status = WritePolicyFile(policy, directory + "/policy.safetensors"); !status.ok()) {
      return status;
    }
    if (auto status = WriteFileAtomically(path, {ResultToJson(result).dump(1)}); !status.ok()) {
      return status;
    }
    return result;
  }

 private:
  // Returns the run's dataset. Records it once for all runs of the same environment and seed.
  absl::StatusOr<const EpisodeSource*> Data(const ReportRun& run) {
    auto& dataset = datasets_[{run.environment, run.seed}];
    if (dataset == nullptr) {
      ASSIGN_OR_RETURN(Dataset recorded, RecordDataset(DataOptions(options_, run)));
      dataset = std::make_unique<const EpisodeSource>(std::move(recorded));
    }
    return dataset.get();
  }

  absl::StatusOr<Policy> Train(const ReportRun& run, const std::string& directory,
                               std::vector<LossPoint>* losses) {
    ASSIGN_OR_RETURN(const EpisodeSource* dataset, Data(run));
    const TrainOptions options = TrainingOptions(options_, run);
    RETURN_IF_ERROR(options.Validate());
    Policy initial = InitialPolicy(run.config, *dataset, run.seed);
    Trainer trainer(std::move(initial), *dataset, options);
    const std::string checkpoint = directory + "/checkpoint.pt", curve = directory + "/losses.json";
    if (std::filesystem::exists(checkpoint)) {
      RETURN_IF_ERROR(trainer.LoadCheckpoint(checkpoint));
      ReadLosses(curve, trainer.iteration(), losses);
    }
    const int interval = std::max(1, options.iterations / kValidations);
    while (!trainer.done()) {
      if (const auto step = trainer.Step(); !step.ok()) return step.status();
      if (!trainer.done() && trainer.iteration() % interval != 0) continue;
      if (trainer.has_validation()) {
        losses->push_back({trainer.iteration(), trainer.ValidationLoss()});
      }
      Json json = Json::array();
      for (const LossPoint& point : *losses) json.push_back({point.iteration, point.loss});
      absl::Status status = WriteFileAtomically(curve, {json.dump()});
      status.Update(trainer.SaveCheckpoint(checkpoint));
      if (!status.ok()) return status;
    }
    return trainer.CurrentPolicy();
  }

  // Reads an interrupted run's loss curve up to the iteration of its checkpoint.
  static void ReadLosses(const std::string& path, int iteration, std::vector<LossPoint>* losses) {
    std::ifstream file(path);
    const Json json = Json::parse(file, nullptr, /*allow_exceptions=*/false);
    if (!json.is_array()) return;
    for (const Json& point : json) {
      if (point.at(0) <= iteration) losses->push_back({point.at(0), point.at(1)});
    }
  }

  absl::Status Play(const Policy& policy, ReportResult* result) const {
    auto shared = std::make_shared<const Policy>(policy);
    ASSIGN_OR_RETURN(Insight insight, LookInside(shared, kFirstUnseenSeed));
    const auto begin = std::chrono::steady_clock::now();
    ASSIGN_OR_RETURN(const Evaluation evaluation,
                     Evaluate(std::move(shared),
                              {.episodes = options_.episodes, .first_seed = kFirstUnseenSeed}));
    const std::chrono::duration<double> taken = std::chrono::steady_clock::now() - begin;
    result->insight = std::move(insight);
    result->evaluation = ToJson(evaluation, policy.config);
    result->returns = evaluation.returns;
    result->seconds_per_decision = taken.count() / static_cast<double>(evaluation.decisions);
    result->omega = policy.weights.phase_omega.values;
    result->phi = policy.weights.phase_phi.values;
    return absl::OkStatus();
  }

  const ReportOptions& options_;
  std::map<std::pair<std::string, uint64_t>, std::unique_ptr<const EpisodeSource>> datasets_;
};

}  // namespace

std::string ReportRun::name() const {
  return absl::StrCat(environment, "-", std::string(ToString(config.mode)), "-T", config.ticks,
                      "-N", config.context, "-seed", seed);
}

std::vector<ReportRun> ModeRuns(const ReportOptions& options) {
  std::vector<ReportRun> runs;
  for (const std::string& environment : options.environments) {
    for (const Mode mode : kReportModes) {
      for (int seed = 1; seed <= options.seeds; ++seed) {
        ReportRun& run = runs.emplace_back(ReportRun{environment, options.config});
        run.config.mode = mode;
        run.seed = static_cast<uint64_t>(seed);
      }
    }
  }
  return runs;
}

std::vector<ReportRun> SweepRuns(const ReportOptions& options) {
  std::vector<ReportRun> runs;
  const auto add = [&](int ModelConfig::*field, int value) {
    for (int seed = 1; seed <= options.seeds; ++seed) {
      ReportRun& run = runs.emplace_back(ReportRun{options.environments[0], options.config});
      run.config.mode = Mode::kFull;
      run.config.*field = value;
      run.seed = static_cast<uint64_t>(seed);
    }
  };
  for (const int ticks : options.ticks) add(&ModelConfig::ticks, ticks);
  for (const int context : options.contexts) add(&ModelConfig::context, context);
  return runs;
}

ReportGroups GroupRuns(const std::vector<ReportResult>& results) {
  ReportGroups groups;
  for (const ReportResult& result : results) {
    groups[{result.run.environment, result.run.config.mode}].push_back(&result);
  }
  return groups;
}

Json PageData(const ReportOptions& options, const std::vector<std::string>& commands) {
  const auto list = [](const std::vector<ReportRun>& runs) {
    Json listed = Json::array();
    for (const ReportRun& run : runs) {
      listed.push_back({{"run", run.name()},
                        {"task", run.environment},
                        {"mode", ToString(run.config.mode)},
                        {"ticks", run.config.ticks},
                        {"context", run.config.context}});
    }
    return listed;
  };
  return {{"commands", commands},
          {"settings",
           {{"seeds", options.seeds},
            {"steps", options.data.steps},
            {"expert_fraction", options.data.expert_fraction},
            {"disturbed_fraction", options.data.disturbed_fraction},
            {"iterations", options.training.iterations},
            {"batch", options.training.batch},
            {"hidden_size", options.config.hidden_size},
            {"ticks", options.config.ticks},
            {"context", options.config.context},
            {"episodes", options.episodes}}},
          {"modes", list(ModeRuns(options))},
          {"sweeps", list(SweepRuns(options))}};
}

absl::StatusOr<std::vector<ReportResult>> RunAll(
    const ReportOptions& options, const std::vector<ReportRun>& runs,
    const std::function<void(const std::string&)>& log) {
  Runner runner(options);
  std::vector<ReportResult> results;
  for (const ReportRun& run : runs) {
    ASSIGN_OR_RETURN(ReportResult result, runner.Run(run, log));
    results.push_back(std::move(result));
  }
  return results;
}

}  // namespace spikeserve
