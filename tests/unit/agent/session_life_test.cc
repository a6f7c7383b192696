// Tests the summary of a session's life.
#include "core/agent/session_life.h"

#include <cstdint>

#include "gtest/gtest.h"

namespace spikeserve {
namespace {

// Counts `decisions` decisions with as many spikes as their index, and checks that the summary has
// each of them in one part.
void CheckLife(uint64_t first, uint64_t decisions) {
  SessionLife life(first, /*first_episode=*/0);
  for (uint64_t i = 0; i < decisions; ++i) {
    life.OnDecision(absl::Seconds(static_cast<double>(i)), i, /*seconds=*/1.0);
  }
  const auto parts = life.decisions();
  EXPECT_LE(parts.size(), ThinnedSeries<SessionLife::Decisions>::kPoints);
  uint64_t next = first;
  for (const auto& [begin, count, sum] : parts) {
    EXPECT_EQ(begin, next);
    EXPECT_LE(count, parts[0].count);
    next += count;
    const auto last = static_cast<double>(next - first - 1);
    EXPECT_FLOAT_EQ(sum.until, static_cast<float>(last));
    EXPECT_FLOAT_EQ(sum.seconds, static_cast<float>(count));
    // The sum of the indices from `begin` to the last one.
    EXPECT_FLOAT_EQ(sum.spikes,
                    static_cast<float>(static_cast<double>(count) *
                                       (static_cast<double>(begin - first) + last) / 2));
  }
  EXPECT_EQ(next, first + decisions);
}

TEST(SessionLifeTest, EveryDecisionIsInOnePart) {
  for (const uint64_t decisions : {0u, 1u, 23u, 24u, 25u, 47u, 48u, 49u, 1000u}) {
    CheckLife(0, decisions);
  }
}

TEST(SessionLifeTest, ARestoredSessionContinuesItsNumbers) { CheckLife(500, 30); }

TEST(SessionLifeTest, ReturnsAreAveraged) {
  SessionLife life(0, /*first_episode=*/2);
  EXPECT_EQ(life.ended_episodes(), 0u);
  for (int i = 0; i < 100; ++i) life.OnEpisode(i);
  EXPECT_EQ(life.ended_episodes(), 100u);
  EXPECT_EQ(life.mean_return(), 49.5);
  EXPECT_EQ(life.last_return(), 99.0);
  double sum = 0.0;
  for (const auto& [first, count, part] : life.episodes()) sum += part.episode_return;
  EXPECT_EQ(sum, 4950.0);
  EXPECT_EQ(life.episodes()[0].first, 2u);
}

}  // namespace
}  // namespace spikeserve
