// Computes the figures that the status page shows, over a window of time.
//
//   const FigureSource server(history, /*labels=*/{});
//   nlohmann::json figures = server.Figures({.from = now - absl::Minutes(1), .to = now});
//
// Free functions and plain values, safe to call from many threads while the history does not
// change. A figure without data is null. server/web/static/schema.json describes all figures.
#pragma once

#include <map>
#include <string>
#include <vector>

#include "absl/time/time.h"
#include "nlohmann/json.hpp"
#include "server/history/metric_history.h"

namespace spikeserve {

// The status codes of calls that agents get wrong. All other errors are those of the server.
bool IsAgentMistake(const std::string& code);
bool IsServerError(const std::string& code);

// Returns the series of `spikeserve_rpc_duration_seconds` for which `wanted` returns true for the
// labels method and code.
Selection SelectCalls(const MetricHistory& history,
                      bool (*wanted)(const std::string& method, const std::string& code));

// The figures of one policy version or of the whole server.
class FigureSource {
 public:
  // `labels` are {"policy", "version"} of a version, or empty for the server. `history` must
  // outlive this object and must not change meanwhile.
  FigureSource(const MetricHistory& history, const MetricLabels& labels);

  // Returns the figures of a window.
  nlohmann::json Figures(TimeSpan span) const;

  // Returns the main figures of each of the windows between successive `times`, as one list for
  // each figure.
  nlohmann::json Series(const std::vector<absl::Duration>& times) const;

  // Returns true if no session was open at the end of the window, and nothing happened in it.
  bool IsIdle(TimeSpan span) const;

 private:
  nlohmann::json Energy(const char* unit, TimeSpan span, double divisor) const;
  // Adds the figures that Series has, too.
  void AddMain(TimeSpan span, nlohmann::json* figures) const;

  const MetricHistory& history_;
  const bool is_server_;
  Selection decisions_, spikes_, durations_, returns_, sessions_, errors_, unusual_, drift_,
      updates_, held_out_, trimmed_;
  std::map<std::string, Selection> spikes_by_stage_;
  std::map<std::string, Selection> energy_by_model_;
  std::map<std::string, Selection> dense_energy_by_model_;  // of a version only
  // Of the server only.
  Selection calls_, acts_, failed_, refused_;
};

// Returns the figures of the calls of each method in a window, as a list.
nlohmann::json CallFigures(const MetricHistory& history, TimeSpan span);

}  // namespace spikeserve
