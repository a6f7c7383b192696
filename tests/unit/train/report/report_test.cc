// The report's arithmetic, its tables and the data of its figures.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "train/report/report_page.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;
using testing::Not;

TEST(IntervalTest, IsStudentsOverSeeds) {
  const Interval interval = IntervalOf({1.0, 2.0, 3.0});
  EXPECT_NEAR(interval.mean, 2.0, 1e-12);
  EXPECT_NEAR(interval.half_width, 4.303 / std::sqrt(3.0), 1e-3);
  EXPECT_TRUE(std::isinf(IntervalOf({1.0}).half_width));
}

// Returns a finished run whose returns all equal `value`.
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
  result.insight.spikes = {90, 91, 110};
  return result;
}

// Two seeds of every mode on CartPole-v1. Mode pos returns 480 on average, every other mode 400.
class ReportTest : public testing::Test {
 protected:
  ReportTest() {
    options_.directory = "x";
    options_.environments = {"CartPole-v1"};
    options_.seeds = 2;
    for (const ReportRun& run : ModeRuns(options_)) {
      const double spread = run.seed == 1 ? 0.1 : -0.1;
      modes_.push_back(Finished(run, (run.config.mode == Mode::kPos ? 480.0 : 400.0) + spread));
    }
  }

  Report Write() const { return WriteReport(options_, "spiketrain report --out=x", modes_, {}); }

  ReportOptions options_;
  std::vector<ReportResult> modes_;
};

TEST_F(ReportTest, SaysWhatTheIntervalsAllow) {
  const Report report = Write();
  EXPECT_THAT(report.markdown, HasSubstr("| CartPole-v1 | pos | 480.0 ± 1.3 | 474.1 | 500.0 |"));
  EXPECT_THAT(
      report.markdown,
      HasSubstr("pos returns 80.0 ± 0.0 more than baseline (significant); route returns 0.0 ± 0.0 "
                "more than baseline (not significant)"));
  EXPECT_THAT(report.markdown, HasSubstr("spiketrain train --out=CartPole-v1-dense-T10-N20-seed2"));
  EXPECT_THAT(report.markdown, HasSubstr("| CartPole-v1 | route | 0.250 | 0.750 | 0.500 |"));
  EXPECT_THAT(report.markdown,
              HasSubstr("```\nspiketrain report --out=x\npython train/report/plot.py x\n```"));
}

TEST_F(ReportTest, FiguresHoldTheRuns) {
  const nlohmann::ordered_json figures = Write().figures;
  const auto task = [&](const char* figure) { return figures.at(figure).at("CartPole-v1").dump(); };
  EXPECT_THAT(task("losses"), HasSubstr(R"("unit":"cross-entropy, nats")"));
  EXPECT_THAT(task("losses"), HasSubstr(R"("dense":[[[10,0.5],[20,0.25]],[[10,0.5],[20,0.25]]])"));
  EXPECT_EQ(figures.at("spikes_by_stage").at("CartPole-v1").size(), 4u);
  EXPECT_THAT(task("spikes_by_stage"), HasSubstr(R"("full":{"coder":60.0,"phase":40.0})"));
  const std::string histogram =
      R"({"edges":[90,93,96,99,102,105,108,111,114],"decisions":[2,0,0,0,0,0,1,0]})";
  EXPECT_EQ(task("spikes_per_decision"),
            absl::StrCat(R"({"baseline":)", histogram, R"(,"full":)", histogram, "}"));
  EXPECT_EQ(task("phases"), "[[1.0,1.0],[2.0,2.0],[1.0,1.0],[2.0,2.0]]");  // both seeds
  EXPECT_EQ(task("gates"),
            R"({"route":[[0.25,0.75],[0.75,0.25]],"full":[[0.25,0.75],[0.75,0.25]]})");
}

TEST_F(ReportTest, SweepsHaveEverySeedOfEachShape) {
  options_.ticks = {5};
  options_.contexts = {100};
  std::vector<ReportResult> sweeps;
  for (const ReportRun& run : SweepRuns(options_)) {
    sweeps.push_back(Finished(run, run.seed == 1 ? 300.0 : 302.0));
  }
  ASSERT_EQ(sweeps.size(), 4u);
  const std::string page = WriteReport(options_, "spiketrain report", modes_, sweeps).markdown;
  EXPECT_THAT(page, HasSubstr("| CartPole-v1 | 10 | 20 | 400.0 ± 1.3 | 100.0 ± 0.0 |"));
  EXPECT_THAT(page, HasSubstr("| CartPole-v1 | 5 | 20 | 301.0 ± 12.7 | 100.0 ± 0.0 |"));
  EXPECT_THAT(page, HasSubstr("| CartPole-v1 | 10 | 100 | 301.0 ± 12.7 | 100.0 ± 0.0 |"));
}

TEST_F(ReportTest, PhaseSpikesAreThoseOfTheNeuronModel) {
  options_.config.context = 2;
  options_.config.ticks = 2;
  for (ReportResult& result : modes_) result.run.config.context = result.run.config.ticks = 2;
  // sin(omega tau + phi) > 0 for omega = phi = 1 at tau = 0, 0.5, 1 and 1.5, and for 2 at 0 and
  // 0.5.
  EXPECT_EQ(Write().figures.at("phase_spikes").dump(),
            R"({"task":"CartPole-v1","timesteps":2,"heads":[[0.0,0.5,1.0,1.5],[0.0,0.5]]})");
}

TEST_F(ReportTest, MembraneIsResetWhereItReachesTheThreshold) {
  const nlohmann::ordered_json membrane = Write().figures.at("membrane");
  EXPECT_EQ(membrane.at("threshold"), 1.0);
  const auto& strongest = membrane.at("potentials").back();
  EXPECT_EQ(strongest.at(0), 0.3);
  const std::vector<float> potential = strongest.at(1);
  ASSERT_EQ(potential.size(), 41u);
  EXPECT_NEAR(potential[3], 0.3 * (1.0 + 0.95 + 0.95 * 0.95), 1e-6);
  EXPECT_EQ(potential[4], 0.0f);
}

TEST_F(ReportTest, SurrogatesAreLargestAtTheThreshold) {
  const nlohmann::ordered_json surrogates = Write().figures.at("surrogates");
  EXPECT_EQ(surrogates.at("slope"), 10.0);
  ASSERT_EQ(surrogates.at("curves").size(), 3u);
  const auto value = [&](const char* kind, size_t point) {
    return surrogates.at("curves").at(kind).at(point).at(1).get<double>();
  };
  EXPECT_EQ(value("fast_sigmoid", 40), 1.0);
  EXPECT_NEAR(value("fast_sigmoid", 42), 1.0 / 2.25, 1e-6);  // at 0.05
  EXPECT_NEAR(value("sigmoid", 40), 0.25, 1e-6);
  EXPECT_NEAR(value("piecewise_linear", 42), 0.5, 1e-6);
  EXPECT_EQ(value("piecewise_linear", 80), 0.0);
}

TEST_F(ReportTest, LinksOnlyToFiguresWithData) {
  EXPECT_THAT(Write().markdown, HasSubstr("](losses.png)"));
  for (ReportResult& result : modes_) result.losses.clear();
  const Report without = Write();
  EXPECT_FALSE(without.figures.contains("losses"));
  EXPECT_THAT(without.markdown, Not(HasSubstr("](losses.png)")));
  EXPECT_THAT(without.markdown, HasSubstr("](membrane.png)"));
}

}  // namespace
}  // namespace spikeserve
