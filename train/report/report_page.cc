#include "train/report/report_page.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "core/neuron/lif.h"
#include "train/report/document.h"
#include "train/report/svg_chart.h"

namespace spikeserve {
namespace {

using Key = std::pair<std::string, Mode>;  // environment, mode
using Group = std::vector<const ReportResult*>;

constexpr Mode kModes[] = {Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull, Mode::kDense};

// What the paper prints for its four spiking modes, in the order of kModes.
struct PaperRow {
  const char* environment;
  double returns[4];  // its Table 4, over 50 episodes
  double optimum;     // dynamic programming and search, Gymnasium's seeds 0 to 999
};
constexpr PaperRow kPaper[] = {{"CartPole-v1", {452.3, 474.1, 479.2, 492.3}, 500.0},
                               {"MountainCar-v0", {-120.2, -111.5, -109.8, -102.4}, -97.56},
                               {"Acrobot-v1", {-87.1, -72.0, -68.3, -59.7}, -58.68},
                               {"Pendulum-v1", {-155.3, -140.0, -135.4, -130.5}, -135.30}};
constexpr double kPaperLoss[] = {0.68, 0.63, 0.61, 0.55};          // its Table 2, epoch 100
constexpr double kPaperSpikes[] = {12000, 11000, 9000, 8000};      // its Table 3, per inference
constexpr double kPaperMilliseconds[] = {15.2, 14.8, 13.5, 12.1};  // its Table 3

const PaperRow* PaperOf(const std::string& environment) {
  for (const PaperRow& row : kPaper) {
    if (environment == row.environment) return &row;
  }
  return nullptr;
}

std::string Name(Mode mode) { return std::string(ToString(mode)); }

std::string Text(const Interval& interval, int digits) {
  const std::string mean = absl::StrFormat("%.*f", digits, interval.mean);
  if (!std::isfinite(interval.half_width)) return mean + " (one seed)";
  return absl::StrFormat("%s ± %.*f", mean, digits, interval.half_width);
}

// Bars over equal intervals of the values' range, named by where they begin.
std::string Histogram(const ChartText& text, const std::vector<int64_t>& values) {
  constexpr int kBins = 8;
  if (values.empty()) return "";
  const auto [least, most] = std::minmax_element(values.begin(), values.end());
  const int64_t width = (*most - *least) / kBins + 1;
  std::vector<std::string> begins;
  Series bars;
  for (int i = 0; i < kBins; ++i) {
    begins.push_back(absl::StrCat(*least + i * width));
    bars.points.emplace_back(0.0, 0.0);
  }
  for (const int64_t value : values) bars.points[(value - *least) / width].second += 1.0;
  return BarChart(text, begins, {bars});
}

class Writer {
 public:
  Writer(const ReportOptions& options, const std::vector<ReportResult>& modes,
         const std::vector<ReportResult>& sweeps)
      : options_(options), sweeps_(sweeps) {
    for (const ReportResult& result : modes) {
      groups_[{result.run.environment, result.run.config.mode}].push_back(&result);
    }
  }

  Report Write(const std::string& command) {
    Introduction(command);
    Returns();
    Losses();
    Spikes();
    Sweeps();
    Phases();
    Gates();
    Membrane();
    Commands();
    return {page_.Markdown(), page_.Html()};
  }

 private:
  // A number of every seed of a group, as an interval.
  template <typename Value>
  Interval Over(const std::string& environment, Mode mode, Value value) const {
    std::vector<double> values;
    for (const ReportResult* result : groups_.at({environment, mode})) {
      values.push_back(value(*result));
    }
    return IntervalOf(values);
  }
  static double Return(const ReportResult& result) { return result.evaluation.at("mean_return"); }

  void Introduction(const std::string& command) {
    page_.Title("The paper's experiments, measured");
    page_.Paragraph(absl::StrFormat(
        "Every mode on every task, %d seed(s) each: %d steps of data, %g %% of them the expert's, "
        "%g %% the expert's disturbed by bursts of random actions, the rest random; %d iterations "
        "of %d clips, d = %d, T = %d, N = %d. Returns are over %d starts a seed that training "
        "never saw, from environment seed 2000000 on. ± is half a 95 %% confidence interval by "
        "Student's t over seeds. The figures are in report.html.",
        options_.seeds, options_.data.steps, 100.0 * options_.data.expert_fraction,
        100.0 * options_.data.disturbed_fraction, options_.training.iterations,
        options_.training.batch, options_.config.hidden_size, options_.config.ticks,
        options_.config.context, options_.episodes));
    page_.Paragraph("Made by:");
    page_.Code(command);
  }

  void Returns() {
    page_.Heading("Returns by mode and task (the paper's Table 4)");
    std::vector<std::vector<std::string>> rows;
    for (const std::string& environment : options_.environments) {
      const PaperRow* paper = PaperOf(environment);
      for (size_t m = 0; m < std::size(kModes); ++m) {
        rows.push_back({environment, Name(kModes[m]), Text(Over(environment, kModes[m], Return), 1),
                        paper != nullptr && m < 4 ? absl::StrFormat("%.1f", paper->returns[m]) : "",
                        paper != nullptr ? absl::StrFormat("%.1f", paper->optimum) : ""});
      }
    }
    page_.Table({"task", "mode", "return", "the paper's", "optimum"}, rows);
    for (const std::string& environment : options_.environments) {
      page_.Paragraph(absl::StrCat(environment, ", seed by seed on the same data: ",
                                   Compare(environment, Mode::kPos, Mode::kBaseline), "; ",
                                   Compare(environment, Mode::kRoute, Mode::kBaseline), "; ",
                                   Compare(environment, Mode::kFull, Mode::kBaseline), "; ",
                                   Compare(environment, Mode::kFull, Mode::kDense), "."));
    }
  }

  // How much more one mode returns than another, and whether that is more than chance: Student's
  // paired t over seeds, for a seed is also that of the data.
  std::string Compare(const std::string& environment, Mode mode, Mode other) const {
    const Group &a = groups_.at({environment, mode}), &b = groups_.at({environment, other});
    std::vector<double> differences;
    for (size_t i = 0; i < a.size(); ++i) differences.push_back(Return(*a[i]) - Return(*b[i]));
    const Interval difference = IntervalOf(differences);
    const bool apart = std::abs(difference.mean) > difference.half_width;
    return absl::StrFormat("%s returns %.1f ± %.1f %s than %s, which is %s chance", Name(mode),
                           std::abs(difference.mean), difference.half_width,
                           difference.mean < 0.0 ? "less" : "more", Name(other),
                           apart ? "more than" : "not told from");
  }

  void Losses() {
    page_.Heading("Loss on held-out episodes (the paper's Table 2)");
    std::vector<std::vector<std::string>> rows;
    for (const std::string& environment : options_.environments) {
      std::vector<Series> series;
      for (size_t m = 0; m < std::size(kModes); ++m) {
        const Group& group = groups_.at({environment, kModes[m]});
        if (group[0]->losses.empty()) continue;
        rows.push_back(
            {environment, Name(kModes[m]),
             Text(Over(environment, kModes[m],
                       [](const ReportResult& result) { return result.losses.back().loss; }),
                  4),
             m < 4 ? absl::StrFormat("%.2f", kPaperLoss[m]) : ""});
        Series& line = series.emplace_back(Series{Name(kModes[m]), {}});
        for (const LossPoint& point : group[0]->losses) {
          line.points.emplace_back(point.iteration, point.loss);
        }
      }
      page_.Figure(LineChart({environment + ", seed 1", "iteration", "loss"}, series));
    }
    page_.Table({"task", "mode", "loss at the end", "the paper's, one figure for all tasks"}, rows);
  }

  void Spikes() {
    page_.Heading("Spikes and latency by mode (the paper's Table 3)");
    page_.Paragraph(
        "The paper gives spikes per inference, a full window; a decision here computes its three "
        "new tokens alone. Milliseconds are of one decision of the streaming engine and the "
        "environment's step on the machine that made this report; the paper's are of a forward and "
        "backward pass on another.");
    std::vector<std::vector<std::string>> rows;
    for (const std::string& environment : options_.environments) {
      std::vector<Series> by_stage;
      std::vector<std::string> stages;
      for (size_t m = 0; m < std::size(kModes); ++m) {
        if (kModes[m] == Mode::kDense) continue;
        const auto field = [](const char* name) {
          return [name](const ReportResult& r) { return r.evaluation.at(name).get<double>(); };
        };
        rows.push_back({environment, Name(kModes[m]),
                        Text(Over(environment, kModes[m], field("spikes_per_decision")), 1),
                        Text(Over(environment, kModes[m], field("spikes_per_window")), 1),
                        absl::StrFormat("%.0f", kPaperSpikes[m]),
                        absl::StrFormat("%.3f", 1e3 * Over(environment, kModes[m],
                                                           [](const ReportResult& r) {
                                                             return r.seconds_per_decision;
                                                           })
                                                          .mean),
                        absl::StrFormat("%.1f", kPaperMilliseconds[m])});
        stages.clear();
        Series& bars = by_stage.emplace_back(Series{Name(kModes[m]), {}});
        const ReportResult& first = *groups_.at({environment, kModes[m]})[0];
        for (const auto& [stage, spikes] :
             first.evaluation.at("spikes_per_decision_by_stage").items()) {
          stages.push_back(stage);
          bars.points.emplace_back(0.0, spikes.get<double>());
        }
      }
      page_.Figure(
          BarChart({environment + ", seed 1", "stage", "spikes per decision"}, stages, by_stage));
    }
    for (const std::string& environment : options_.environments) {
      page_.Figure(Histogram(
          {environment + ", full, seed 1: decisions of one episode", "spikes", "decisions"},
          groups_.at({environment, Mode::kFull})[0]->insight.spikes));
    }
    page_.Table({"task", "mode", "spikes per decision", "spikes per window",
                 "the paper's spikes per inference", "milliseconds", "the paper's"},
                rows);
  }

  void Sweeps() {
    if (sweeps_.empty()) return;
    page_.Heading("Sweeps of ticks and context (the paper's appendix)");
    std::vector<std::vector<std::string>> rows;
    for (const ReportResult& result : sweeps_) {
      rows.push_back(
          {result.run.environment, absl::StrCat(result.run.config.ticks),
           absl::StrCat(result.run.config.context), absl::StrFormat("%.1f", Return(result)),
           absl::StrFormat("%.1f", result.evaluation.at("spikes_per_decision").get<double>()),
           absl::StrFormat("%.3f", 1e3 * result.seconds_per_decision)});
    }
    page_.Table({"task", "T", "N", "return", "spikes per decision", "milliseconds"}, rows);
  }

  void Phases() {
    page_.Heading("Phase generators");
    page_.Paragraph(
        "Figures: frequency and phase of every generator after training, and the spikes of the "
        "first task's over a window.");
    std::vector<Series> scatter;
    for (const std::string& environment : options_.environments) {
      Series& dots = scatter.emplace_back(Series{environment.substr(0, environment.find('-')), {}});
      for (const ReportResult* result : groups_.at({environment, Mode::kFull})) {
        for (size_t h = 0; h < result->omega.size(); ++h) {
          dots.points.emplace_back(result->omega[h], result->phi[h]);
        }
      }
    }
    page_.Figure(
        ScatterChart({"Learned frequencies and phases, full mode", "omega", "phi"}, scatter));
    const ReportResult& first = *groups_.at({options_.environments[0], Mode::kFull})[0];
    std::vector<std::vector<double>> rows(first.omega.size());
    for (size_t h = 0; h < rows.size(); ++h) {
      for (int i = 0; i < options_.config.context * options_.config.ticks; ++i) {
        const double tau = static_cast<double>(i) / options_.config.ticks;
        const double angle =
            static_cast<double>(first.omega[h]) * tau + static_cast<double>(first.phi[h]);
        if (std::sin(angle) > 0.0) rows[h].push_back(tau);
      }
    }
    page_.Figure(RasterChart(
        {options_.environments[0] + ": phase spikes of a window, seed 1", "timestep", "head"},
        rows));
  }

  void Gates() {
    page_.Heading("Routing gates");
    page_.Paragraph(
        "Means over ticks of the first layer's gates, full mode, seed 1, over the window of the "
        "last decision of an episode (the paper's heatmap). Uniform gates would be 1/H.");
    std::vector<std::vector<std::string>> rows;
    for (const std::string& environment : options_.environments) {
      const auto& gates = groups_.at({environment, Mode::kFull})[0]->insight.gates;
      if (gates.empty()) continue;
      page_.Figure(HeatChart({environment, "token", "head"}, gates));
      double least = 1.0, most = 0.0, variation = 0.0;
      for (const auto& head : gates) {
        const auto [low, high] = std::minmax_element(head.begin(), head.end());
        least = std::min(least, *low);
        most = std::max(most, *high);
        variation = std::max(variation, *high - *low);
      }
      rows.push_back({environment, absl::StrFormat("%.3f", least), absl::StrFormat("%.3f", most),
                      absl::StrFormat("%.3f", variation)});
    }
    page_.Table({"task", "least gate", "largest gate", "most that one head's gate varies"}, rows);
  }

  // Of model.md's neuron itself; nothing here was trained.
  void Membrane() {
    page_.Heading("The neuron");
    page_.Paragraph("Figure: its membrane potential under three constant currents.");
    constexpr int kTicks = 40;
    const Lif lif = {options_.config.membrane_decay, options_.config.threshold};
    std::vector<Series> lines;
    for (const float current : {0.04f, 0.1f, 0.3f}) {
      Series& line = lines.emplace_back(Series{absl::StrFormat("I = %g", current), {{0.0, 0.0}}});
      float membrane = 0.0f;
      for (int tick = 1; tick <= kTicks; ++tick) {
        lif.Step(current, membrane);
        line.points.emplace_back(tick, membrane);
      }
    }
    page_.Figure(LineChart(
        {"Membrane potential under constant currents, after each tick", "tick", "V"}, lines));
  }

  void Commands() {
    page_.Heading("Every row again");
    std::vector<std::string> lines;
    for (const auto& [key, group] : groups_) {
      for (const ReportResult* result : group) lines.push_back(result->command);
    }
    for (const ReportResult& result : sweeps_) lines.push_back(result.command);
    page_.Code(absl::StrJoin(lines, "\n"));
  }

  const ReportOptions& options_;
  const std::vector<ReportResult>& sweeps_;
  std::map<Key, Group> groups_;
  Document page_;
};

}  // namespace

Interval IntervalOf(const std::vector<double>& values) {
  // Student's t, two-sided 95 %, by degrees of freedom from 1.
  constexpr double kT[] = {12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262};
  const auto count = static_cast<double>(values.size());
  Interval interval = {.mean = std::accumulate(values.begin(), values.end(), 0.0) / count,
                       .half_width = std::numeric_limits<double>::infinity()};
  if (values.size() < 2) return interval;
  double squares = 0.0;
  for (const double value : values) squares += (value - interval.mean) * (value - interval.mean);
  const double t = kT[std::min(values.size() - 2, std::size(kT) - 1)];
  interval.half_width = t * std::sqrt(squares / (count - 1.0) / count);
  return interval;
}

Report WriteReport(const ReportOptions& options, const std::string& command,
                   const std::vector<ReportResult>& modes,
                   const std::vector<ReportResult>& sweeps) {
  return Writer(options, modes, sweeps).Write(command);
}

}  // namespace spikeserve
