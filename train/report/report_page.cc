#include "train/report/report_page.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_join.h"
#include "core/contract/dcheck.h"
#include "core/math/vector_view.h"
#include "train/report/figure_data.h"

namespace spikeserve {
namespace {

// The paper's results for its four spiking modes, in the order of kReportModes.
struct PaperRow {
  const char* environment;
  double returns[4];  // its Table 4, means over 50 episodes
  double optimum;     // by dynamic programming and search, mean over Gymnasium's seeds 0 to 999
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

// A Markdown text that grows at its end.
class Markdown {
 public:
  void Title(const std::string& text) { absl::StrAppend(&text_, "# ", text, "\n\n"); }
  void Heading(const std::string& text) { absl::StrAppend(&text_, "## ", text, "\n\n"); }
  void Paragraph(const std::string& text) { absl::StrAppend(&text_, text, "\n\n"); }
  void Code(const std::string& text) { absl::StrAppend(&text_, "```\n", text, "\n```\n\n"); }
  void Image(const std::string& text, const std::string& file) {
    absl::StrAppend(&text_, "![", text, "](", file, ")\n\n");
  }
  // REQUIRES: every row is as long as `header`.
  void Table(const std::vector<std::string>& header,
             const std::vector<std::vector<std::string>>& rows) {
    Row(header);
    Row(std::vector<std::string>(header.size(), "---"));
    for (const std::vector<std::string>& row : rows) Row(row);
    absl::StrAppend(&text_, "\n");
  }

  const std::string& text() const { return text_; }

 private:
  void Row(const std::vector<std::string>& cells) {
    absl::StrAppend(&text_, "| ", absl::StrJoin(cells, " | "), " |\n");
  }

  std::string text_;
};

class Writer {
 public:
  Writer(const ReportOptions& options, const std::vector<ReportResult>& modes,
         const std::vector<ReportResult>& sweeps)
      : options_(options),
        sweeps_(sweeps),
        groups_(GroupRuns(modes)),
        figures_(FigureData(options, groups_)) {}

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
    return {page_.text(), figures_};
  }

 private:
  // Returns the interval of one number over the seeds of a task and mode.
  template <typename Value>
  Interval Over(const std::string& environment, Mode mode, Value value) const {
    return Over(groups_.at({environment, mode}), value);
  }
  template <typename Value>
  static Interval Over(const std::vector<const ReportResult*>& seeds, Value value) {
    std::vector<double> values;
    for (const ReportResult* result : seeds) values.push_back(value(*result));
    return IntervalOf(values);
  }
  static double Return(const ReportResult& result) { return result.evaluation.at("mean_return"); }
  static double SpikesOf(const ReportResult& result) {
    return result.evaluation.at("spikes_per_decision");
  }
  static double Seconds(const ReportResult& result) { return result.seconds_per_decision; }

  // Links to the figure if there is data for it.
  void Figure(const std::string& name, const std::string& text) {
    if (figures_.contains(name)) page_.Image(text, name + ".png");
  }

  void Introduction(const std::string& command) {
    page_.Title("The paper's experiments, measured");
    page_.Paragraph(absl::StrFormat(
        "Every mode on every task from %d seed(s). The data of a seed are %d steps: %g %% from the "
        "expert, %g %% from the expert disturbed by bursts of random actions, and the rest from "
        "random actions. Training takes %d iterations of %d clips; d = %d, T = %d, N = %d. Returns "
        "are means over %d starts a seed that training never saw, from environment seed 2000000 "
        "on. ± is half the width of a 95 %% confidence interval by Student's t over seeds; a "
        "difference that is larger than it is called significant.",
        options_.seeds, options_.data.steps, 100.0 * options_.data.expert_fraction,
        100.0 * options_.data.disturbed_fraction, options_.training.iterations,
        options_.training.batch, options_.config.hidden_size, options_.config.ticks,
        options_.config.context, options_.episodes));
    page_.Paragraph(
        "These commands make the report; the second one draws the figures from figures.json:");
    page_.Code(absl::StrCat(command, "\n", PlotCommand(options_.directory)));
  }

  void Returns() {
    page_.Heading("Returns by mode and task (the paper's Table 4)");
    std::vector<std::vector<std::string>> rows;
    for (const std::string& environment : options_.environments) {
      const PaperRow* paper = PaperOf(environment);
      for (size_t m = 0; m < std::size(kReportModes); ++m) {
        rows.push_back({environment, Name(kReportModes[m]),
                        Text(Over(environment, kReportModes[m], Return), 1),
                        paper != nullptr && m < 4 ? absl::StrFormat("%.1f", paper->returns[m]) : "",
                        paper != nullptr ? absl::StrFormat("%.1f", paper->optimum) : ""});
      }
    }
    page_.Table({"task", "mode", "return", "the paper's", "optimum"}, rows);
    for (const std::string& environment : options_.environments) {
      page_.Paragraph(absl::StrCat(environment, ", paired by seed and data: ",
                                   Compare(environment, Mode::kPos, Mode::kBaseline), "; ",
                                   Compare(environment, Mode::kRoute, Mode::kBaseline), "; ",
                                   Compare(environment, Mode::kFull, Mode::kBaseline), "; ",
                                   Compare(environment, Mode::kFull, Mode::kDense), "."));
    }
  }

  // Appends how much more one mode returns than another, and whether the difference is significant
  // by Student's paired t over seeds. The pairs are the seeds, which also determine the data.
  std::string Compare(const std::string& environment, Mode mode, Mode other) const {
    const auto &a = groups_.at({environment, mode}), &b = groups_.at({environment, other});
    std::vector<double> differences;
    for (size_t i = 0; i < a.size(); ++i) differences.push_back(Return(*a[i]) - Return(*b[i]));
    const Interval difference = IntervalOf(differences);
    const bool apart = std::abs(difference.mean) > difference.half_width;
    return absl::StrFormat("%s returns %.1f ± %.1f %s than %s (%s)", Name(mode),
                           std::abs(difference.mean), difference.half_width,
                           difference.mean < 0.0 ? "less" : "more", Name(other),
                           apart ? "significant" : "not significant");
  }

  void Losses() {
    page_.Heading("Loss on held-out episodes (the paper's Table 2)");
    std::vector<std::vector<std::string>> rows;
    for (const std::string& environment : options_.environments) {
      for (size_t m = 0; m < std::size(kReportModes); ++m) {
        if (groups_.at({environment, kReportModes[m]})[0]->losses.empty()) continue;
        rows.push_back(
            {environment, Name(kReportModes[m]),
             Text(Over(environment, kReportModes[m],
                       [](const ReportResult& result) { return result.losses.back().loss; }),
                  4),
             m < 4 ? absl::StrFormat("%.2f", kPaperLoss[m]) : ""});
      }
    }
    Figure("losses",
           "Loss on held-out episodes over the iterations of training, by mode, every seed");
    page_.Table({"task", "mode", "loss at the end", "the paper's, one figure for all tasks"}, rows);
  }

  void Spikes() {
    page_.Heading("Spikes and latency by mode (the paper's Table 3)");
    page_.Paragraph(
        "The paper counts the spikes of one inference, which computes a full window; a decision "
        "here computes only its three new tokens. Milliseconds are the time of one decision of the "
        "streaming engine and one step of the environment, on the machine that made this report; "
        "the paper's are the time of a forward and a backward pass on another machine.");
    std::vector<std::vector<std::string>> rows;
    for (const std::string& environment : options_.environments) {
      for (size_t m = 0; m < std::size(kReportModes); ++m) {
        const Mode mode = kReportModes[m];
        if (mode == Mode::kDense) continue;
        const auto of_window = [](const ReportResult& r) {
          return r.evaluation.at("spikes_per_window").get<double>();
        };
        rows.push_back({environment, Name(mode), Text(Over(environment, mode, SpikesOf), 1),
                        Text(Over(environment, mode, of_window), 1),
                        absl::StrFormat("%.0f", kPaperSpikes[m]),
                        absl::StrFormat("%.3f", 1e3 * Over(environment, mode, Seconds).mean),
                        absl::StrFormat("%.1f", kPaperMilliseconds[m])});
      }
    }
    Figure("spikes_by_stage",
           "Mean spikes per decision in each stage of the model, by mode, seed 1");
    Figure("spikes_per_decision",
           "Histograms of the spikes of the decisions of one episode, baseline and full, seed 1");
    page_.Table({"task", "mode", "spikes per decision", "spikes per window",
                 "the paper's spikes per inference", "milliseconds", "the paper's"},
                rows);
  }

  void Sweeps() {
    if (sweeps_.empty()) return;
    page_.Heading("Sweeps of ticks and context (the paper's appendix)");
    // The seeds of each T and N. The shape of all other runs comes first.
    std::map<std::pair<int, int>, std::vector<const ReportResult*>> shapes;
    std::vector<std::pair<int, int>> order;
    const auto add = [&](const ReportResult& result) {
      const std::pair shape = {result.run.config.ticks, result.run.config.context};
      if (shapes[shape].empty()) order.push_back(shape);
      shapes[shape].push_back(&result);
    };
    const std::string& environment = sweeps_.front().run.environment;
    for (const ReportResult* result : groups_.at({environment, Mode::kFull})) add(*result);
    for (const ReportResult& result : sweeps_) add(result);
    std::vector<std::vector<std::string>> rows;
    for (const auto& shape : order) {
      const auto& seeds = shapes.at(shape);
      rows.push_back({environment, absl::StrCat(shape.first), absl::StrCat(shape.second),
                      Text(Over(seeds, Return), 1), Text(Over(seeds, SpikesOf), 1),
                      absl::StrFormat("%.3f", 1e3 * Over(seeds, Seconds).mean)});
    }
    page_.Table({"task", "T", "N", "return", "spikes per decision", "milliseconds"}, rows);
  }

  void Phases() {
    page_.Heading("Phase generators");
    page_.Paragraph(
        "The frequency and phase of every generator after training, in full mode, and the spikes "
        "of the first task's generators over one window, seed 1.");
    Figure("phases", "Frequency and phase of every phase generator after training, by task");
    Figure("phase_spikes", "Spikes of every head's phase generator over one window");
  }

  void Gates() {
    page_.Heading("Routing gates");
    page_.Paragraph(
        "The gates of the first layer as means over ticks, over the window of the last decision of "
        "an episode, seed 1 (the paper's heatmaps). Uniform gates equal 1/H.");
    Figure("gates", "Mean gate of every head for every token of the window, by task and mode");
    std::vector<std::vector<std::string>> rows;
    for (const std::string& environment : options_.environments) {
      for (const Mode mode : {Mode::kRoute, Mode::kFull}) {
        const auto& gates = groups_.at({environment, mode})[0]->insight.gates;
        if (!gates.empty()) rows.push_back(GatesRow(environment, mode, gates));
      }
    }
    page_.Table({"task", "mode", "least gate", "largest gate", "most that one head's gate varies"},
                rows);
  }

  static std::vector<std::string> GatesRow(const std::string& environment, Mode mode,
                                           const std::vector<std::vector<double>>& gates) {
    double least = 1.0, most = 0.0, variation = 0.0;
    for (const auto& head : gates) {
      const auto [low, high] = std::minmax_element(head.begin(), head.end());
      least = std::min(least, *low);
      most = std::max(most, *high);
      variation = std::max(variation, *high - *low);
    }
    return {environment, Name(mode), absl::StrFormat("%.3f", least), absl::StrFormat("%.3f", most),
            absl::StrFormat("%.3f", variation)};
  }

  void Membrane() {
    page_.Heading("The neuron");
    page_.Paragraph(
        "The membrane potential of one neuron under three constant input currents. The neuron has "
        "no trained parameters.");
    Figure("membrane", "Membrane potential after each tick under three constant input currents");
    page_.Paragraph(
        "The surrogate gradients that replace the derivative of its spike in training, with the "
        "slope of these runs.");
    Figure("surrogates", "Derivative of each surrogate over the distance to the threshold");
  }

  void Commands() {
    page_.Heading("The command of every run");
    std::vector<std::string> lines;
    for (const auto& [key, group] : groups_) {
      for (const ReportResult* result : group) lines.push_back(result->command);
    }
    for (const ReportResult& result : sweeps_) lines.push_back(result.command);
    page_.Code(absl::StrJoin(lines, "\n"));
  }

  const ReportOptions& options_;
  const std::vector<ReportResult>& sweeps_;
  const ReportGroups groups_;
  const nlohmann::ordered_json figures_;
  Markdown page_;
};

}  // namespace

Interval IntervalOf(const std::vector<double>& values) {
  SPIKESERVE_DCHECK(!values.empty());
  // Student's t, two-sided 95 %, by degrees of freedom from 1.
  constexpr double kT[] = {12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262};
  const auto count = static_cast<double>(values.size());
  Interval interval = {.mean = AsVector(values).mean(),
                       .half_width = std::numeric_limits<double>::infinity()};
  if (values.size() < 2) return interval;
  const double squares = (AsVector(values).array() - interval.mean).square().sum();
  const double t = kT[std::min(values.size() - 2, std::size(kT) - 1)];
  interval.half_width = t * std::sqrt(squares / (count - 1.0) / count);
  return interval;
}

std::string PlotCommand(const std::string& directory) {
  return absl::StrCat("python train/report/plot.py ", directory);
}

Report WriteReport(const ReportOptions& options, const std::string& command,
                   const std::vector<ReportResult>& modes,
                   const std::vector<ReportResult>& sweeps) {
  return Writer(options, modes, sweeps).Write(command);
}

}  // namespace spikeserve
