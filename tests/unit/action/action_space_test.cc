#include "core/action/action_space.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <limits>
#include <string>

namespace spikeserve {
namespace {

using testing::ElementsAre;

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kLargest = std::numeric_limits<float>::max();

Action Continuous(std::vector<float> values) {
  return {.discrete = 0, .continuous = std::move(values)};
}

Action Index(int index) { return {.discrete = index, .continuous = {}}; }

TEST(ActionSpace, DiscreteIsOneHot) {
  const ActionSpace space = ActionSpace::Discrete(3);
  EXPECT_TRUE(space.is_discrete());
  EXPECT_EQ(space.size(), 3);
  std::vector<float> encoded(3, 7.0f);
  space.Encode(Index(1), absl::MakeSpan(encoded));
  EXPECT_THAT(encoded, ElementsAre(0.0f, 1.0f, 0.0f));
}

TEST(ActionSpace, BoxMapsItsBoundsToPlusMinusOne) {
  const ActionSpace space = ActionSpace::Box({-2.0f, 0.0f, 1.0f}, {2.0f, 10.0f, 3.0f});
  EXPECT_FALSE(space.is_discrete());
  EXPECT_EQ(space.size(), 3);
  std::vector<float> encoded(3);
  space.Encode(Continuous({-2.0f, 10.0f, 1.5f}), absl::MakeSpan(encoded));
  EXPECT_THAT(encoded, ElementsAre(-1.0f, 1.0f, -0.5f));
  EXPECT_THAT(space.FromUnit(encoded), ElementsAre(-2.0f, 10.0f, 1.5f));
}

TEST(ActionSpace, FromUnitClampsToTheBounds) {
  const ActionSpace space = ActionSpace::Box({-2.0f, 0.0f}, {2.0f, 10.0f});
  EXPECT_THAT(space.FromUnit({-1.5f, 2.0f}), ElementsAre(-2.0f, 10.0f));
}

TEST(ActionSpace, TheWidestBoundsDoNotOverflow) {
  const ActionSpace space = ActionSpace::Box({-kLargest}, {kLargest});
  ASSERT_TRUE(space.Validate().ok());
  std::vector<float> encoded(1);
  space.Encode(Continuous({kLargest}), absl::MakeSpan(encoded));
  EXPECT_THAT(encoded, ElementsAre(1.0f));
  EXPECT_THAT(space.FromUnit({-1.0f}), ElementsAre(-kLargest));
}

TEST(ActionSpace, ContainsNamesWhatIsWrong) {
  const ActionSpace discrete = ActionSpace::Discrete(2);
  EXPECT_TRUE(discrete.Contains(Index(1)).ok());
  EXPECT_EQ(discrete.Contains(Index(2)).message(),
            "action: expected an index from 0 to 1, received 2");
  EXPECT_EQ(discrete.Contains(Index(-1)).code(), absl::StatusCode::kInvalidArgument);

  const ActionSpace box = ActionSpace::Box({-2.0f}, {2.0f});
  EXPECT_TRUE(box.Contains(Continuous({2.0f})).ok());
  EXPECT_EQ(box.Contains(Continuous({})).message(), "action: expected 1 values, received 0");
  EXPECT_EQ(box.Contains(Continuous({2.5f})).message(),
            "action[0]: expected -2 to 2, received 2.5");
  EXPECT_EQ(box.Contains(Continuous({kNan})).message(),
            "action[0]: expected -2 to 2, received nan");
}

}  // namespace
}  // namespace spikeserve
