// The paper's tables and figures from finished runs, beside the paper's own figures.
//
// Pure functions of plain values.
#ifndef TRAIN_REPORT_REPORT_PAGE_H_
#define TRAIN_REPORT_REPORT_PAGE_H_

#include <string>
#include <vector>

#include "train/report/report_runs.h"

namespace spikeserve {

struct Report {
  std::string markdown;  // text and tables
  std::string html;      // the same, and the figures; needs no other file
};

// `command` makes the report again; `modes` are the results of ModeRuns, `sweeps` of SweepRuns.
// REQUIRES: at least one of modes.
Report WriteReport(const ReportOptions& options, const std::string& command,
                   const std::vector<ReportResult>& modes, const std::vector<ReportResult>& sweeps);

// The mean of one number from each seed, and half the width of its 95 % confidence interval by
// Student's t over seeds; infinite for a single seed. REQUIRES: at least one.
struct Interval {
  double mean = 0.0;
  double half_width = 0.0;
};
Interval IntervalOf(const std::vector<double>& values);

}  // namespace spikeserve

#endif  // TRAIN_REPORT_REPORT_PAGE_H_
