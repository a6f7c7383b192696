// Plays a fixed sequence of observations and rewards with a policy.
//
// The sequences cover ordinary numbers, the extreme ones that a session accepts, and some that it
// refuses. All numbers come from integer arithmetic, so they are equal on every machine.
// Free functions, thread-safe.
#ifndef TESTS_GOLDEN_GOLDEN_PLAY_H_
#define TESTS_GOLDEN_GOLDEN_PLAY_H_

#include <string>
#include <utility>

namespace spikeserve::golden {

// The kinds of sessions: greedy decisions, sampled ones, and a session that learns.
enum class Kind { kGreedy, kSampled, kLearning };

inline constexpr std::pair<Kind, const char*> kKinds[] = {
    {Kind::kGreedy, "greedy"}, {Kind::kSampled, "sampled"}, {Kind::kLearning, "learning"}};

// Returns all answers of a session with the policy file at `path`, as bytes: actions, logits,
// probabilities, returns-to-go, spikes by stage, all other counts, which requests were refused, and
// what the session has learned. Ends the program if the file cannot be read.
std::string PlayGolden(const std::string& path, Kind kind);

}  // namespace spikeserve::golden

#endif  // TESTS_GOLDEN_GOLDEN_PLAY_H_
