// The report's arithmetic and its two forms.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>

#include "train/report/document.h"
#include "train/report/report_page.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;

TEST(IntervalTest, IsStudentsOverSeeds) {
  const Interval interval = IntervalOf({1.0, 2.0, 3.0});
  EXPECT_NEAR(interval.mean, 2.0, 1e-12);
  EXPECT_NEAR(interval.half_width, 4.303 / std::sqrt(3.0), 1e-3);
  EXPECT_TRUE(std::isinf(IntervalOf({1.0}).half_width));
}

TEST(DocumentTest, SaysTheSameInBothForms) {
  Document document;
  document.Title("A < B");
  document.Table({"x", "y"}, {{"1", "2"}});
  document.Figure("<svg></svg>");
  EXPECT_EQ(document.Markdown(), "# A < B\n\n| x | y |\n| --- | --- |\n| 1 | 2 |\n\n");
  EXPECT_THAT(document.Html(), HasSubstr("<h1>A &lt; B</h1>"));
  EXPECT_THAT(document.Html(), HasSubstr("<tr><td>1</td><td>2</td></tr>"));
  EXPECT_THAT(document.Html(), HasSubstr("<svg></svg>"));
}

// A finished run whose returns are all `value`.
ReportResult Finished(const ReportRun& run, double value) {
  ReportResult result;
  result.run = run;
  result.command = "spiketrain train --out=" + run.name();
  result.losses = {{10, 0.5}, {20, 0.25}};
  result.evaluation = {{"mean_return", value},
                       {"spikes_per_decision", 100.0},
                       {"spikes_per_window", 2000.0},
                       {"spikes_per_decision_by_stage", {{"coder", 60.0}, {"phase", 40.0}}}};
  result.returns = {value, value};
  if (run.config.has_phase()) result.omega = result.phi = {1.0f, 2.0f};
  if (run.config.has_routing()) result.insight.gates = {{0.25, 0.75}, {0.75, 0.25}};
  result.insight.spikes = {90, 100, 110};
  return result;
}

TEST(ReportTest, SaysWhatTheIntervalsAllow) {
  ReportOptions options;
  options.environments = {"CartPole-v1"};
  options.seeds = 2;
  std::vector<ReportResult> modes;
  for (const ReportRun& run : ModeRuns(options)) {
    const double spread = run.seed == 1 ? 0.1 : -0.1;
    modes.push_back(Finished(run, (run.config.mode == Mode::kPos ? 480.0 : 400.0) + spread));
  }
  const Report report = WriteReport(options, "spiketrain report --out=x", modes, {});
  EXPECT_THAT(report.markdown, HasSubstr("| CartPole-v1 | pos | 480.0 ± 1.3 | 474.1 | 500.0 |"));
  EXPECT_THAT(
      report.markdown,
      HasSubstr("pos returns 80.0 ± 0.0 more than baseline, which is more than chance; route "
                "returns 0.0 ± 0.0 more than baseline, which is not told from chance"));
  EXPECT_THAT(report.markdown, HasSubstr("spiketrain train --out=CartPole-v1-dense-T10-N20-seed2"));
  EXPECT_THAT(report.markdown, HasSubstr("| CartPole-v1 | 0.250 | 0.750 | 0.500 |"));
  EXPECT_THAT(report.html, HasSubstr("<polyline"));
  EXPECT_THAT(report.html, HasSubstr("<title>0.75</title>"));
}

}  // namespace
}  // namespace spikeserve
