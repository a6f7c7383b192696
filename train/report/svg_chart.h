// Small charts as SVG text, for a page that needs nothing but itself.
//
// Pure functions of plain values.
#ifndef TRAIN_REPORT_SVG_CHART_H_
#define TRAIN_REPORT_SVG_CHART_H_

#include <string>
#include <utility>
#include <vector>

namespace spikeserve {

struct Series {
  std::string name;
  std::vector<std::pair<double, double>> points;  // x, y
};

struct ChartText {
  std::string title;
  std::string x;  // axis labels
  std::string y;
};

// Lines through each series' points.
std::string LineChart(const ChartText& text, const std::vector<Series>& series);

// A dot for each point.
std::string ScatterChart(const ChartText& text, const std::vector<Series>& series);

// Groups of bars: a group for each category, in it a bar for each series, whose points' y are the
// heights. REQUIRES: as many points as categories.
std::string BarChart(const ChartText& text, const std::vector<std::string>& categories,
                     const std::vector<Series>& series);

// A square for each value, darker for larger ones; row 0 is at the bottom. Every value has a
// tooltip. REQUIRES: rows of one length.
std::string HeatChart(const ChartText& text, const std::vector<std::vector<double>>& rows);

// Row r has a mark at every x of rows[r].
std::string RasterChart(const ChartText& text, const std::vector<std::vector<double>>& rows);

}  // namespace spikeserve

#endif  // TRAIN_REPORT_SVG_CHART_H_
