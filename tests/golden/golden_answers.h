// Hashes the answers of policies to the sequences of golden_play.h, and keeps the hashes in a file.
// Free functions, thread-safe.
#ifndef TESTS_GOLDEN_GOLDEN_ANSWERS_H_
#define TESTS_GOLDEN_GOLDEN_ANSWERS_H_

#include <map>
#include <string>
#include <vector>

#include "tests/golden/golden_play.h"

namespace spikeserve::golden {

// Hashes by "POLICY/VERSION KIND".
using Answers = std::map<std::string, std::string>;

// Returns the folders "POLICY/VERSION" below `policies`, sorted.
std::vector<std::string> ListVersions(const std::string& policies);

// Returns the SHA-256 of PlayGolden(path, kind), in hexadecimal. Ends the program if the file
// cannot be read, as do the functions below if theirs cannot be written.
std::string HashAnswers(const std::string& path, Kind kind);

// Returns the hashes of every version below `policies`.
Answers HashAll(const std::string& policies);

// Reads and writes the file of hashes: one line "POLICY/VERSION KIND HASH" each.
Answers ReadAnswers(const std::string& path);
void WriteAnswers(const std::string& path, const Answers& answers);

}  // namespace spikeserve::golden

#endif  // TESTS_GOLDEN_GOLDEN_ANSWERS_H_
