// Plays a fixed sequence of observations and rewards with a policy.
//
// The sequences cover ordinary numbers, the extreme ones that a session accepts, and some that it
// refuses. All numbers come from integer arithmetic, so they are equal on every machine.
// Free functions, thread-safe.
#pragma once

#include <string>
#include <utility>
#include <vector>

#include "core/model/policy.h"

namespace spikeserve::golden {

// The kinds of sessions: greedy decisions, sampled ones, and a session that learns.
enum class Kind { kGreedy, kSampled, kLearning };

inline constexpr std::pair<Kind, const char*> kKinds[] = {
    {Kind::kGreedy, "greedy"}, {Kind::kSampled, "sampled"}, {Kind::kLearning, "learning"}};

// A policy and the name of its answers.
struct Subject {
  std::string name;
  Policy policy;
};

// Returns small random policies in float32, one for each mode and one with other parts.
std::vector<Subject> RandomSubjects();

// Reads a policy file. Ends the program if it cannot be read.
Policy ReadPolicy(const std::string& path);

// Returns all answers of a session with the policy, as bytes: actions, logits, probabilities,
// returns-to-go, spikes by stage, all other counts, which requests were refused, and what the
// session has learned.
std::string PlayGolden(const Policy& policy, Kind kind);

}  // namespace spikeserve::golden
