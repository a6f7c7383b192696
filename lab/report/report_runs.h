// The runs of the paper's experiments: every task in every mode from several seeds, on the paper's
// own data, and sweeps of ticks and context.
//
// Each run has a directory of its own, which is kept. A finished run is read from its result.json,
// and an interrupted run continues from its checkpoint.
//
// Thread-safety: ModeRuns, SweepRuns, GroupRuns and PageData are pure functions. RunAll may run at
// the same time in several processes that share a directory, each with other environments.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "core/model/config.h"
#include "lab/report/insight.h"
#include "nlohmann/json.hpp"
#include "train/recording/record.h"
#include "train/trainer/trainer.h"

namespace spikeserve {

struct ReportOptions {
  std::string directory;
  std::vector<std::string> environments = {"CartPole-v1", "MountainCar-v0", "Acrobot-v1",
                                           "Pendulum-v1"};
  int seeds = 3;          // number of seeds of data and training: 1, 2, ...
  RecordOptions data;     // environment and seed are ignored; the default is the paper's recipe
  TrainOptions training;  // the seed is ignored
  int episodes = 200;     // evaluation starts for each seed, which training never saw
  ModelConfig config;     // the mode is ignored
  std::vector<int> ticks = {5, 20, 40};       // values of T in the sweep, besides config.ticks
  std::vector<int> contexts = {10, 50, 100};  // values of N in the sweep, besides config.context
};

// The modes of the report, in the order of its tables and figures.
inline constexpr Mode kReportModes[] = {Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull,
                                        Mode::kDense};

// Names one policy to train.
struct ReportRun {
  std::string environment;
  ModelConfig config;
  uint64_t seed = 0;

  // Returns the run's name, which is also the name of its directory.
  std::string name() const;
};

struct LossPoint {
  int iteration = 0;
  double loss = 0.0;  // on held-out episodes
};

struct ReportResult {
  ReportRun run;
  std::string command;                // the spiketrain command that trains the same policy
  std::vector<LossPoint> losses;      // empty without held-out episodes
  nlohmann::ordered_json evaluation;  // the output of `spiketrain eval --json`
  std::vector<double> returns;        // one per episode
  std::vector<float> omega, phi;      // [H], rad per timestep and rad; empty without phase spikes
  Insight insight;                    // from the first start
  double seconds_per_decision = 0.0;  // streaming engine and environment step together
};

// The results of every task and mode, each in the order of its seeds.
using ReportGroups =
    std::map<std::pair<std::string, Mode>, std::vector<const ReportResult*>>;  // environment, mode

// Returns the runs of every environment in every mode from every seed.
std::vector<ReportRun> ModeRuns(const ReportOptions& options);
// Returns the runs of the first environment in full mode, with each of the options' ticks and
// contexts from every seed.
std::vector<ReportRun> SweepRuns(const ReportOptions& options);

// Groups the results of ModeRuns. The groups point into `results`.
ReportGroups GroupRuns(const std::vector<ReportResult>& results);

// Returns what lab/report/report_page.py reads besides the runs' results: the commands that make
// the report, its settings, and the names and shapes of ModeRuns ("modes") and SweepRuns
// ("sweeps").
nlohmann::ordered_json PageData(const ReportOptions& options,
                                const std::vector<std::string>& commands);

// Trains and plays every run of `runs` that has no result yet, and returns the results of all.
// Calls `log` with the name of each run that it starts. Returns FAILED_PRECONDITION, naming the
// run, if a finished run was made with other options.
absl::StatusOr<std::vector<ReportResult>> RunAll(
    const ReportOptions& options, const std::vector<ReportRun>& runs,
    const std::function<void(const std::string&)>& log);

}  // namespace spikeserve
