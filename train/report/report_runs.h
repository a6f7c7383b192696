// The runs of the paper's experiments: every task in every mode from several seeds, on the paper's
// own data, and sweeps of ticks and context.
//
// A run lives in a directory of its own and is kept: one that is finished is read, one that was
// interrupted goes on from its checkpoint.
#ifndef TRAIN_REPORT_REPORT_RUNS_H_
#define TRAIN_REPORT_REPORT_RUNS_H_

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/model/config.h"
#include "nlohmann/json.hpp"
#include "train/data/record.h"
#include "train/report/insight.h"
#include "train/trainer/trainer.h"

namespace spikeserve {

struct ReportOptions {
  std::string directory;
  std::vector<std::string> environments = {"CartPole-v1", "MountainCar-v0", "Acrobot-v1",
                                           "Pendulum-v1"};
  int seeds = 3;                     // of data and training: 1, 2, ...
  RecordOptions data;                // all but environment and seed; by default the paper's recipe
  TrainOptions training;             // all but the seed
  int episodes = 200;                // unseen starts for each seed
  ModelConfig config;                // all but the mode
  std::vector<int> ticks = {5, 20};  // the sweep of T, beside config's own
  std::vector<int> contexts = {10, 50};  // the sweep of N, beside config's own
};

// One trained policy.
struct ReportRun {
  std::string environment;
  ModelConfig config;
  uint64_t seed = 0;

  // Names the run and its directory.
  std::string name() const;
};

struct LossPoint {
  int iteration = 0;
  double loss = 0.0;  // on held-out episodes
};

struct ReportResult {
  ReportRun run;
  std::string command;  // trains the same policy
  std::vector<LossPoint> losses;
  nlohmann::ordered_json evaluation;  // as `spiketrain eval --json` prints it
  std::vector<double> returns;        // per episode
  std::vector<float> omega, phi;      // [H] of a mode with phase spikes; else empty
  Insight insight;                    // of the first start
  double seconds_per_decision = 0.0;  // of the streaming engine, with the environment's step
};

// Every environment in every mode from every seed.
std::vector<ReportRun> ModeRuns(const ReportOptions& options);
// The first environment in full mode, with each of the options' ticks and contexts.
std::vector<ReportRun> SweepRuns(const ReportOptions& options);

// Trains and plays what is missing of `runs`. `log` gets a line for every run that is begun.
// FAILED_PRECONDITION names a finished run that was made with other options.
absl::StatusOr<std::vector<ReportResult>> RunAll(
    const ReportOptions& options, const std::vector<ReportRun>& runs,
    const std::function<void(const std::string&)>& log);

}  // namespace spikeserve

#endif  // TRAIN_REPORT_REPORT_RUNS_H_
