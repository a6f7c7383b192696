// Plays a fixed sequence of observations and rewards with a policy, and hashes all answers.
//
// The sequences cover ordinary numbers, the extreme ones that a session accepts, and some that it
// refuses. All numbers come from integer arithmetic, so they are equal on every machine.
// Free functions, thread-safe.
#ifndef TESTS_GOLDEN_GOLDEN_ANSWERS_H_
#define TESTS_GOLDEN_GOLDEN_ANSWERS_H_

#include <map>
#include <string>
#include <vector>

namespace spikeserve::golden {

// The kinds of sessions: greedy decisions, sampled ones, and a session that learns.
enum class Kind { kGreedy, kSampled, kLearning };

// Hashes by "POLICY/VERSION KIND".
using Answers = std::map<std::string, std::string>;

// Returns the folders "POLICY/VERSION" below `policies`, sorted.
std::vector<std::string> ListVersions(const std::string& policies);

// Returns the SHA-256, in hexadecimal, of all answers of a session with the policy file at `path`:
// actions, logits, probabilities, returns-to-go, spikes by stage, all other counts, which requests
// were refused, and what the session has learned. Ends the program if the file cannot be read, as
// do the functions below if theirs cannot be written.
std::string HashAnswers(const std::string& path, Kind kind);

// Returns the hashes of every version below `policies`.
Answers HashAll(const std::string& policies);

// Reads and writes the file of hashes: one line "POLICY/VERSION KIND HASH" each.
Answers ReadAnswers(const std::string& path);
void WriteAnswers(const std::string& path, const Answers& answers);

}  // namespace spikeserve::golden

#endif  // TESTS_GOLDEN_GOLDEN_ANSWERS_H_
