// The algebra of learning against scalar loops, bit for bit: a recorded session must replay equally
// with any SIMD width and any version of the algebra library.

#include <gtest/gtest.h>

#include <cmath>
#include <utility>
#include <vector>

#include "core/learning/frobenius_norm.h"
#include "core/learning/head_update.h"
#include "core/learning/learner.h"
#include "core/math/counter_random.h"
#include "core/math/vector_view.h"

namespace spikeserve {
namespace {

// Outputs and inputs of the head; most leave a remainder in a SIMD register.
constexpr std::pair<size_t, size_t> kShapes[] = {{1, 1}, {2, 3}, {3, 7}, {5, 33}, {6, 128}};

template <typename T>
std::vector<T> Draw(uint64_t key, size_t size) {
  std::vector<T> values(size);
  for (size_t i = 0; i < size; ++i) {
    values[i] = static_cast<T>(2.0 * UniformDouble(RandomBits({key, i})) - 1.0);
  }
  return values;
}

template <typename T>
double Norm(const std::vector<T>& values) {
  double squares = 0.0;
  for (const T value : values) squares += static_cast<double>(value) * static_cast<double>(value);
  return std::sqrt(squares);
}

template <typename T>
void ExpectEqualNorms() {
  for (const auto& [outputs, inputs] : kShapes) {
    for (uint64_t key = 0; key < 20; ++key) {
      const std::vector<T> values = Draw<T>(key, outputs * inputs);
      EXPECT_EQ(FrobeniusNorm(AsVector(values)), Norm(values)) << values.size();
    }
  }
}

TEST(ScalarLoopsTest, NormsAreEqual) {
  ExpectEqualNorms<float>();
  ExpectEqualNorms<double>();
}

TEST(ScalarLoopsTest, TracesAndCreditAreEqual) {
  const LearningOptions options = {.trace_decay = 0.9, .discount = 0.97};
  const auto decay = static_cast<float>(options.trace_decay);
  for (const auto& [outputs, inputs] : kShapes) {
    const size_t size = outputs * inputs;
    Learner learner =
        Learner::New(options, {}, Eigen::VectorXf::Zero(static_cast<Eigen::Index>(size)));
    std::vector<float> trace(size);
    std::vector<double> trace_sum(size), discounted_trace(size), credit(size);
    for (uint64_t t = 0; t < 50; ++t) {
      ActionChoice choice;
      choice.noise = Draw<float>(2 * t, outputs);  // y of a sampled Box action
      const std::vector<float> readout = Draw<float>(2 * t + 1, inputs);
      const double reward = 0.1 * static_cast<double>(t % 7);
      learner.OnDecision(options, {}, choice, readout, /*return_to_go=*/0.0, reward);
      for (size_t i = 0; i < size; ++i) {
        if (t > 0) credit[i] += reward * discounted_trace[i];
        const float product = choice.noise[i / inputs] * readout[i % inputs];
        trace[i] = decay * trace[i] + product;
        trace_sum[i] += static_cast<double>(trace[i]);
        discounted_trace[i] =
            options.discount * discounted_trace[i] + static_cast<double>(trace[i]);
      }
    }
    EXPECT_EQ(learner.trace, AsVector(trace)) << size;
    EXPECT_EQ(learner.trace_sum, AsVector(trace_sum)) << size;
    EXPECT_EQ(learner.discounted_trace, AsVector(discounted_trace)) << size;
    EXPECT_EQ(learner.credit, AsVector(credit)) << size;
  }
}

template <typename T>
void ExpectEqualUpdates(const UpdateBounds& bounds) {
  for (const auto& [outputs, inputs] : kShapes) {
    const std::vector<T> direction = Draw<T>(100, outputs * inputs);
    std::vector<float> expected = Draw<float>(200, outputs * inputs);
    Eigen::VectorXf actual = AsVector(expected);
    EXPECT_EQ(ApplyUpdate(0.37, Eigen::VectorX<T>(AsVector(direction)), bounds, &actual),
              UpdateOutcome::kApplied);

    const double norm = 0.37 * Norm(direction);
    const double factor = norm > bounds.clip ? 0.37 * (bounds.clip / norm) : 0.37;
    for (size_t i = 0; i < expected.size(); ++i) {
      const double step = factor * static_cast<double>(direction[i]);
      expected[i] = static_cast<float>(static_cast<double>(expected[i]) + step);
    }
    const double drift = Norm(expected);
    if (drift > bounds.max_norm) {
      const double shrink = bounds.max_norm / drift;
      for (float& value : expected) value = static_cast<float>(static_cast<double>(value) * shrink);
    }
    EXPECT_EQ(actual, AsVector(expected)) << expected.size();
  }
}

TEST(ScalarLoopsTest, UpdatesAreEqual) {
  for (const double clip : {1e-3, 1e9}) {
    for (const double max_norm : {0.01, 1e9}) {
      ExpectEqualUpdates<float>({.clip = clip, .max_norm = max_norm});
      ExpectEqualUpdates<double>({.clip = clip, .max_norm = max_norm});
    }
  }
}

}  // namespace
}  // namespace spikeserve
