// The data of the report's figures.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "lab/report/figure_data.h"
#include "lab/report/report_runs.h"

namespace spikeserve {
namespace {

using testing::HasSubstr;

ReportResult Finished(const ReportRun& run) {
  ReportResult result;
  result.run = run;
  result.losses = {{10, 0.5}, {20, 0.25}};
  result.evaluation = {{"spikes_per_decision_by_stage", {{"coder", 60.0}, {"phase", 40.0}}}};
  if (run.config.has_phase()) result.omega = result.phi = {1.0f, 2.0f};
  if (run.config.has_routing()) result.insight.gates = {{0.25, 0.75}, {0.75, 0.25}};
  result.insight.spikes = {90, 91, 110};
  return result;
}

// Two seeds of every mode on CartPole-v1.
class ReportTest : public testing::Test {
 protected:
  ReportTest() {
    options_.environments = {"CartPole-v1"};
    options_.seeds = 2;
    for (const ReportRun& run : ModeRuns(options_)) modes_.push_back(Finished(run));
  }

  nlohmann::ordered_json Figures() const { return FigureData(options_, GroupRuns(modes_)); }

  ReportOptions options_;
  std::vector<ReportResult> modes_;
};

TEST_F(ReportTest, FiguresHoldTheRuns) {
  const nlohmann::ordered_json figures = Figures();
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

TEST_F(ReportTest, PhaseSpikesAreThoseOfTheNeuronModel) {
  options_.config.context = 2;
  options_.config.ticks = 2;
  for (ReportResult& result : modes_) result.run.config.context = result.run.config.ticks = 2;
  // sin(omega tau + phi) > 0 for omega = phi = 1 at tau = 0, 0.5, 1 and 1.5, and for 2 at 0 and
  // 0.5.
  EXPECT_EQ(Figures().at("phase_spikes").dump(),
            R"({"task":"CartPole-v1","timesteps":2,"heads":[[0.0,0.5,1.0,1.5],[0.0,0.5]]})");
}

TEST_F(ReportTest, MembraneIsResetWhereItReachesTheThreshold) {
  const nlohmann::ordered_json membrane = Figures().at("membrane");
  EXPECT_EQ(membrane.at("threshold"), 1.0);
  const auto& strongest = membrane.at("potentials").back();
  EXPECT_EQ(strongest.at(0), 0.3);
  const std::vector<float> potential = strongest.at(1);
  ASSERT_EQ(potential.size(), 41u);
  EXPECT_NEAR(potential[3], 0.3 * (1.0 + 0.95 + 0.95 * 0.95), 1e-6);
  EXPECT_EQ(potential[4], 0.0f);
}

TEST_F(ReportTest, SurrogatesAreLargestAtTheThreshold) {
  const nlohmann::ordered_json surrogates = Figures().at("surrogates");
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

TEST_F(ReportTest, FiguresWithoutDataAreMissing) {
  for (ReportResult& result : modes_) result.losses.clear();
  EXPECT_FALSE(Figures().contains("losses"));
  EXPECT_TRUE(Figures().contains("membrane"));
}

}  // namespace
}  // namespace spikeserve
