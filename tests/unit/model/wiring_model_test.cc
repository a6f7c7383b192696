#include "core/model/wiring_model.h"

#include <gtest/gtest.h>

#include <cstdint>
#include <vector>

#include "core/math/counter_random.h"

namespace spikeserve {
namespace {

constexpr size_t kObs = 5, kAct = 3;

std::vector<double> Draws(uint64_t seed, size_t count) {
  std::vector<double> draws;
  for (uint64_t i = 0; i < count; ++i) {
    draws.push_back(2.0 * UniformDouble(RandomBits({seed, i})) - 1.0);
  }
  return draws;
}

// The naive form of the equation in the header.
std::vector<double> Change(const WiringModel& model, const std::vector<double>& z,
                           const std::vector<float>& action) {
  std::vector<double> terms(WiringModel::Terms(kObs, kAct)), change(kObs, 0.0);
  FillWiringTerms(z, action, absl::MakeSpan(terms));
  for (size_t k = 0; k < terms.size(); ++k) {
    for (size_t i = 0; i < kObs; ++i) change[i] += model.coefficients[k * kObs + i] * terms[k];
  }
  return change;
}

TEST(WiringModelTest, MovedElementsArePredictedAsIfFromTheBeginning) {
  WiringModel model;
  model.mean.assign(kObs, 0.0);
  model.coefficients = Draws(1, WiringModel::Terms(kObs, kAct) * kObs);
  for (const std::vector<float>& action : {std::vector<float>{0.0f, 1.0f, 0.0f}, {0.3f, -1, 1}}) {
    const std::vector<double> z = Draws(2, kObs);
    std::vector<double> terms(WiringModel::Terms(kObs, kAct)), change(kObs), slopes(kObs * kObs);
    model.Predict(z, action, absl::MakeSpan(terms), absl::MakeSpan(change));
    EXPECT_EQ(change, Change(model, z, action));
    model.FillSlopes(z, action, absl::MakeSpan(slopes));
    for (size_t i = 0; i < kObs; ++i) {
      for (size_t j = i + 1; j < kObs; ++j) {
        std::vector<double> moved = z, predicted = change;
        moved[i] += 0.5;
        moved[j] -= 1.25;
        model.AddMoves(slopes, {{i, 0.5}, {j, -1.25}}, absl::MakeSpan(predicted));
        const std::vector<double> expected = Change(model, moved, action);
        for (size_t k = 0; k < kObs; ++k) EXPECT_NEAR(predicted[k], expected[k], 1e-12);
      }
    }
  }
}

}  // namespace
}  // namespace spikeserve
