#include "core/learning/peer_norms.h"

#include <gtest/gtest.h>

#include <initializer_list>
#include <limits>
#include <string>

namespace spikeserve {
namespace {

constexpr double kNoLimit = std::numeric_limits<double>::infinity();

// Adds a contribution of each of the contributors "0", "1" and so on.
PeerNorms Norms(std::initializer_list<double> norms) {
  PeerNorms all;
  int i = 0;
  for (const double norm : norms) all.Add(std::to_string(i++), norm);
  return all;
}

TEST(PeerNormsTest, ThereIsNoLimitBeforeEnoughOthersHaveContributed) {
  const PeerNorms norms = Norms({0.1, 0.1, 0.1, 0.1});
  EXPECT_EQ(norms.Limit("0"), kNoLimit);  // of three others
  EXPECT_DOUBLE_EQ(norms.Limit("new"), 0.1 * PeerNorms::kFactor);
}

TEST(PeerNormsTest, TheLimitFollowsTheMedianOfTheOthers) {
  const PeerNorms norms = Norms({0.3, 0.1, 0.5, 0.2, 0.4});
  EXPECT_DOUBLE_EQ(norms.Limit("new"), 0.3 * PeerNorms::kFactor);
  EXPECT_DOUBLE_EQ(norms.Limit("2"), 0.2 * PeerNorms::kFactor);  // the lower of 0.2 and 0.3
}

TEST(PeerNormsTest, OneContributorCannotRaiseALimit) {
  PeerNorms norms = Norms({0.1, 0.1, 0.1, 0.1, 0.1});
  for (int i = 0; i < 1000; ++i) norms.Add("0", 1e6);
  EXPECT_DOUBLE_EQ(norms.Limit("0"), 0.1 * PeerNorms::kFactor);
  EXPECT_DOUBLE_EQ(norms.Limit("1"), 0.1 * PeerNorms::kFactor);
}

TEST(PeerNormsTest, TheLimitFollowsContributorsThatLearnFaster) {
  PeerNorms norms = Norms({0.1, 0.1, 0.1, 0.1, 0.1});
  for (int i = 0; i < 3; ++i) norms.Add(std::to_string(i), 10.0);
  EXPECT_DOUBLE_EQ(norms.Limit("4"), 10.0 * PeerNorms::kFactor);
}

TEST(PeerNormsTest, AContributionOfZeroSaysNothing) {
  PeerNorms norms = Norms({0.1, 0.1, 0.1, 0.1});
  for (int i = 0; i < 4; ++i) norms.Add(std::to_string(i), 0.0);
  EXPECT_DOUBLE_EQ(norms.Limit("new"), 0.1 * PeerNorms::kFactor);
}

TEST(PeerNormsTest, OnlyTheLastContributorsCount) {
  PeerNorms norms;
  for (size_t i = 0; i < 10 * PeerNorms::kContributors; ++i) norms.Add(std::to_string(i), 1.0);
  EXPECT_EQ(norms.norms.size(), PeerNorms::kContributors);
}

}  // namespace
}  // namespace spikeserve
