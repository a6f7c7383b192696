#include "core/base/names.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"

namespace spikeserve {
namespace {

using ::testing::EndsWith;
using ::testing::StartsWith;

TEST(NamesLike, ShowsFewNamesInTheirOrder) {
  EXPECT_EQ(NamesLike("x", {}), "");
  EXPECT_EQ(NamesLike("x", {"b", "a"}), "b, a");
}

TEST(NamesLike, ShowsTheNearestOfManyNames) {
  std::vector<std::string> names;
  for (int i = 0; i < 5000; ++i) names.push_back(absl::StrFormat("line-%04d-pick-and-place", i));
  const std::string text = NamesLike("line-0042-pick-and-lace", names);
  EXPECT_THAT(text, StartsWith("line-0042-pick-and-place, "));
  EXPECT_THAT(text, EndsWith(" more"));
  EXPECT_LT(text.size(), 700u);
}

TEST(NamesLike, CutsLongNames) {
  const std::string text = NamesLike("x", {std::string(5000, 'a'), std::string(5000, 'b')});
  EXPECT_LT(text.size(), 200u);
}

TEST(DidYouMean, FindsOneOrTwoWrongLetters) {
  const std::vector<std::string> known = {"acrobot", "cartpole", "cartpole-dial", "pendulum"};
  for (const char* typo :
       {"cartpol", "cartpolee", "cartople", "catrpole", "CartPole", "kartpola"}) {
    EXPECT_EQ(DidYouMean(typo, known), "; did you mean cartpole?") << typo;
  }
  for (const char* other : {"", "cart", "c", "hopper", "cartpole-dialled"}) {
    EXPECT_EQ(DidYouMean(other, known), "") << other;
  }
  EXPECT_EQ(DidYouMean(std::string(1 << 20, 'x'), known), "");
}

}  // namespace
}  // namespace spikeserve
