#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "core/neuron/lif.h"
#include "core/neuron/period_table.h"
#include "core/neuron/phase.h"

namespace spikeserve {
namespace {

TEST(LifTest, LeaksFiresAtThresholdAndResetsHard) {
  const Lif lif;
  float membrane = 0.0f;
  EXPECT_FALSE(lif.Step(0.75f, membrane));
  EXPECT_EQ(membrane, 0.75f);
  EXPECT_FALSE(lif.Step(0.0f, membrane));
  EXPECT_EQ(membrane, 0.95f * 0.75f);
  EXPECT_TRUE(lif.Step(2.0f, membrane));
  EXPECT_EQ(membrane, 0.0f);
  EXPECT_TRUE(lif.Step(1.0f, membrane)) << "the membrane equals the threshold";
}

TEST(LifTest, ConstantCurrentFiresWithItsPeriod) {
  const Lif lif;
  for (float current = -0.5f; current < 1.5f; current += 0.003f) {
    const int period = lif.Period(current, 10);
    float membrane = 0.0f;
    for (int tick = 1; tick <= 30; ++tick) {
      const bool spike = lif.Step(current, membrane);
      if (period > 0 || tick <= 10) {
        EXPECT_EQ(spike, period > 0 && tick % period == 0)
            << "current " << current << " tick " << tick;
      }
    }
  }
}

TEST(LifTest, PeriodsOfKnownCurrents) {
  const Lif lif;
  EXPECT_EQ(lif.Period(1.0f, 10), 1);
  EXPECT_EQ(lif.Period(0.52f, 10), 2);  // 0.52 (1 + 0.95) = 1.014
  EXPECT_EQ(lif.Period(0.51f, 10), 3);  // 0.51 (1 + 0.95) = 0.9945, then 1.4548
  EXPECT_EQ(lif.Period(0.05f, 1000), 0) << "the membrane approaches 0.05 / (1 - 0.95) from below";
}

TEST(PeriodTableTest, EqualsTheSimulatedNeuronAroundEveryThreshold) {
  for (const Lif& lif :
       {Lif(), Lif{.decay = 0.5f, .threshold = 0.3f}, Lif{.decay = 1.0f}, Lif{.decay = 0.0f}}) {
    constexpr int kTicks = 37;
    const PeriodTable table(lif, kTicks);
    for (const float threshold : table.thresholds()) {
      for (const float current :
           {std::nextafter(threshold, 0.0f), threshold, std::nextafter(threshold, 2.0f)}) {
        EXPECT_EQ(table.Period(current), lif.Period(current, kTicks)) << current;
      }
    }
    for (float current = -1.0f; current < 2.0f; current += 0.00037f) {
      ASSERT_EQ(table.Period(current), lif.Period(current, kTicks)) << current;
    }
    constexpr float kInfinity = std::numeric_limits<float>::infinity();
    for (const float current : {std::nanf(""), -kInfinity, kInfinity}) {
      EXPECT_EQ(table.Period(current), lif.Period(current, kTicks)) << current;
    }
  }
}

TEST(PhaseTest, IsTheSignOfTheSine) {
  for (float omega = 0.1f; omega < 10.0f; omega += 0.37f) {
    for (float phi = 0.0f; phi < 6.28f; phi += 0.61f) {
      for (int timestep = 0; timestep < 500; timestep += 7) {
        for (int tick = 0; tick < 10; ++tick) {
          const double tau = TimestepPhaseTime(timestep, tick, 10);
          const double sine = std::sin(static_cast<double>(omega) * tau + static_cast<double>(phi));
          if (std::abs(sine) > 1e-9) {
            ASSERT_EQ(PhaseSpike(omega, phi, tau), sine > 0.0);
          }
        }
      }
    }
  }
}

TEST(PhaseTest, ClocksCountAsThePaperAndThePositionDo) {
  EXPECT_DOUBLE_EQ(TimestepPhaseTime(3, 5, 10), 3.5);
  EXPECT_DOUBLE_EQ(WindowPhaseTime(0), 1.0);
  EXPECT_FALSE(PhaseSpike(1.0f, 0.0f, 0.0)) << "sin 0 is not above zero";
}

}  // namespace
}  // namespace spikeserve
