#include "train/report/svg_chart.h"

#include <algorithm>
#include <limits>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"

namespace spikeserve {
namespace {

constexpr double kWidth = 460.0, kHeight = 280.0;
constexpr double kLeft = 62.0, kRight = 12.0, kTop = 46.0, kBottom = 44.0;
// Told apart by readers with any colour vision (Okabe and Ito).
constexpr const char* kColours[] = {"#0072B2", "#E69F00", "#009E73",
                                    "#D55E00", "#CC79A7", "#56B4E9"};

const char* Colour(size_t i) { return kColours[i % std::size(kColours)]; }

struct Range {
  double low = std::numeric_limits<double>::infinity();
  double high = -low;

  void Include(double value) {
    low = std::min(low, value);
    high = std::max(high, value);
  }
  // Of some width, even without values.
  void Widen() {
    if (!(low <= high)) low = high = 0.0;
    if (low == high) low -= 0.5, high += 0.5;
  }
};

// One chart: frame, axes with their ends' values, legend, and then whatever is added.
class Chart {
 public:
  Chart(const ChartText& text, Range x, Range y) : x_(x), y_(y) {
    x_.Widen();
    y_.Widen();
    svg_ = absl::StrFormat(
        "<svg viewBox=\"0 0 %g %g\" width=\"%g\" height=\"%g\" role=\"img\" "
        "font-family=\"sans-serif\" font-size=\"11\">\n",
        kWidth, kHeight, kWidth, kHeight);
    Text(kWidth / 2, 14, "middle", text.title, "font-weight=\"bold\"");
    Text(kWidth / 2, kHeight - 6, "middle", text.x);
    absl::StrAppendFormat(&svg_,
                          "<text transform=\"translate(12 %g) rotate(-90)\" "
                          "text-anchor=\"middle\">%s</text>\n",
                          kHeight / 2, text.y);
    absl::StrAppendFormat(&svg_,
                          "<rect x=\"%g\" y=\"%g\" width=\"%g\" height=\"%g\" fill=\"none\" "
                          "stroke=\"#999\"/>\n",
                          kLeft, kTop, kWidth - kLeft - kRight, kHeight - kTop - kBottom);
    for (const double value : {y_.low, (y_.low + y_.high) / 2, y_.high}) {
      Text(kLeft - 4, Y(value) + 4, "end", absl::StrFormat("%.4g", value));
    }
  }

  double X(double value) const {
    return kLeft + (value - x_.low) / (x_.high - x_.low) * (kWidth - kLeft - kRight);
  }
  double Y(double value) const {
    return kHeight - kBottom - (value - y_.low) / (y_.high - y_.low) * (kHeight - kTop - kBottom);
  }

  void XLabel(double x, const std::string& label) {
    Text(x, kHeight - kBottom + 14, "middle", label);
  }
  void XEnds() {
    for (const double value : {x_.low, x_.high}) XLabel(X(value), absl::StrFormat("%.4g", value));
  }
  void Legend(const std::vector<Series>& series) {
    for (size_t i = 0; i < series.size() && series.size() > 1; ++i) {
      const double x = kLeft + static_cast<double>(i) * 78.0;
      absl::StrAppendFormat(&svg_,
                            "<rect x=\"%g\" y=\"24\" width=\"10\" height=\"10\" fill=\"%s\"/>\n", x,
                            Colour(i));
      Text(x + 13, 33, "start", series[i].name);
    }
  }
  void Add(const std::string& element) { absl::StrAppend(&svg_, element, "\n"); }
  std::string Finish() { return svg_ + "</svg>\n"; }

 private:
  void Text(double x, double y, const char* anchor, const std::string& text,
            const char* more = "") {
    absl::StrAppendFormat(&svg_, "<text x=\"%g\" y=\"%g\" text-anchor=\"%s\" %s>%s</text>\n", x, y,
                          anchor, more, text);
  }

  Range x_, y_;
  std::string svg_;
};

Chart ChartOf(const ChartText& text, const std::vector<Series>& series) {
  Range x, y;
  for (const Series& line : series) {
    for (const auto& [px, py] : line.points) {
      x.Include(px);
      y.Include(py);
    }
  }
  Chart chart(text, x, y);
  chart.XEnds();
  chart.Legend(series);
  return chart;
}

}  // namespace

std::string LineChart(const ChartText& text, const std::vector<Series>& series) {
  Chart chart = ChartOf(text, series);
  for (size_t i = 0; i < series.size(); ++i) {
    std::string points;
    for (const auto& [x, y] : series[i].points) {
      absl::StrAppendFormat(&points, "%.1f,%.1f ", chart.X(x), chart.Y(y));
    }
    chart.Add(absl::StrFormat(
        "<polyline points=\"%s\" fill=\"none\" stroke=\"%s\" stroke-width=\"1.6\"/>", points,
        Colour(i)));
  }
  return chart.Finish();
}

std::string ScatterChart(const ChartText& text, const std::vector<Series>& series) {
  Chart chart = ChartOf(text, series);
  for (size_t i = 0; i < series.size(); ++i) {
    for (const auto& [x, y] : series[i].points) {
      chart.Add(absl::StrFormat("<circle cx=\"%.1f\" cy=\"%.1f\" r=\"4\" fill=\"%s\"/>", chart.X(x),
                                chart.Y(y), Colour(i)));
    }
  }
  return chart.Finish();
}

std::string BarChart(const ChartText& text, const std::vector<std::string>& categories,
                     const std::vector<Series>& series) {
  Range x = {0.0, static_cast<double>(std::max<size_t>(1, categories.size()))}, y = {0.0, 0.0};
  for (const Series& bars : series) {
    for (const auto& point : bars.points) y.Include(point.second);
  }
  Chart chart(text, x, y);
  chart.Legend(series);
  const double width = 0.8 / static_cast<double>(std::max<size_t>(1, series.size()));
  for (size_t c = 0; c < categories.size(); ++c) {
    chart.XLabel(chart.X(static_cast<double>(c) + 0.5), categories[c]);
    for (size_t i = 0; i < series.size(); ++i) {
      const double left = static_cast<double>(c) + 0.1 + width * static_cast<double>(i);
      const double top = chart.Y(std::max(0.0, series[i].points[c].second));
      const double bottom = chart.Y(std::min(0.0, series[i].points[c].second));
      chart.Add(absl::StrFormat(
          "<rect x=\"%.1f\" y=\"%.1f\" width=\"%.1f\" height=\"%.1f\" fill=\"%s\"/>", chart.X(left),
          top, chart.X(left + width) - chart.X(left), bottom - top, Colour(i)));
    }
  }
  return chart.Finish();
}

std::string HeatChart(const ChartText& text, const std::vector<std::vector<double>>& rows) {
  Range x = {-0.5, 0.5}, y = {-0.5, static_cast<double>(rows.size()) - 0.5}, values;
  for (const auto& row : rows) {
    x.high = static_cast<double>(row.size()) - 0.5;
    for (const double value : row) values.Include(value);
  }
  values.Widen();
  Chart chart(text, x, y);
  chart.XEnds();
  for (size_t r = 0; r < rows.size(); ++r) {
    for (size_t c = 0; c < rows[r].size(); ++c) {
      const double left = chart.X(static_cast<double>(c) - 0.5);
      const double top = chart.Y(static_cast<double>(r) + 0.5);
      chart.Add(
          absl::StrFormat("<rect x=\"%.1f\" y=\"%.1f\" width=\"%.1f\" height=\"%.1f\" fill=\"%s\" "
                          "fill-opacity=\"%.3f\"><title>%.4g</title></rect>",
                          left, top, chart.X(static_cast<double>(c) + 0.5) - left,
                          chart.Y(static_cast<double>(r) - 0.5) - top, Colour(0),
                          (rows[r][c] - values.low) / (values.high - values.low), rows[r][c]));
    }
  }
  return chart.Finish();
}

std::string RasterChart(const ChartText& text, const std::vector<std::vector<double>>& rows) {
  Range x, y = {-0.5, static_cast<double>(rows.size()) - 0.5};
  for (const auto& row : rows) {
    for (const double value : row) x.Include(value);
  }
  Chart chart(text, x, y);
  chart.XEnds();
  for (size_t r = 0; r < rows.size(); ++r) {
    const double middle = static_cast<double>(r);
    for (const double value : rows[r]) {
      chart.Add(absl::StrFormat(
          "<line x1=\"%.1f\" x2=\"%.1f\" y1=\"%.1f\" y2=\"%.1f\" stroke=\"%s\"/>", chart.X(value),
          chart.X(value), chart.Y(middle - 0.35), chart.Y(middle + 0.35), Colour(r)));
    }
  }
  return chart.Finish();
}

}  // namespace spikeserve
