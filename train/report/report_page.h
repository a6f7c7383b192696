// The report: the paper's tables from finished runs, beside the paper's own numbers, and the data
// of its figures.
//
// Pure functions of plain values.
#ifndef TRAIN_REPORT_REPORT_PAGE_H_
#define TRAIN_REPORT_REPORT_PAGE_H_

#include <string>
#include <vector>

#include "nlohmann/json.hpp"
#include "train/report/report_runs.h"

namespace spikeserve {

struct Report {
  std::string markdown;            // text, tables and links to the figures' PNG files beside it
  nlohmann::ordered_json figures;  // what train/report/plot.py draws, see FigureData
};

// Returns the command that draws the figures of the report in `directory`.
std::string PlotCommand(const std::string& directory);

// `command` is the command line that makes the report; `modes` are the results of ModeRuns and
// `sweeps` those of SweepRuns. REQUIRES: `modes` is not empty.
Report WriteReport(const ReportOptions& options, const std::string& command,
                   const std::vector<ReportResult>& modes, const std::vector<ReportResult>& sweeps);

// The mean of one number over the seeds, and half the width of its 95 % confidence interval by
// Student's t over seeds, which is infinite for a single seed. REQUIRES: `values` is not empty.
struct Interval {
  double mean = 0.0;
  double half_width = 0.0;
};
Interval IntervalOf(const std::vector<double>& values);

}  // namespace spikeserve

#endif  // TRAIN_REPORT_REPORT_PAGE_H_
