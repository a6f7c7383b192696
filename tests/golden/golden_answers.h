// Hashes the answers of policies to the sequences of golden_play.h, and keeps the hashes in a file.
// Free functions, thread-safe.
#pragma once

#include <map>
#include <string>
#include <vector>

#include "tests/golden/golden_play.h"

namespace spikeserve::golden {

// Hashes by "NAME KIND". The name of a policy file is POLICY/VERSION.
using Answers = std::map<std::string, std::string>;

// Returns the random subjects, and the policies of the folders "POLICY/VERSION" below `policies`.
// Ends the program if a file cannot be read, as WriteAnswers does if it cannot be written.
std::vector<Subject> AllSubjects(const std::string& policies);

// Returns the SHA-256 of PlayGolden(policy, kind), in hexadecimal.
std::string HashAnswers(const Policy& policy, Kind kind);

// Returns the hashes of AllSubjects(policies).
Answers HashAll(const std::string& policies);

// Reads and writes the file of hashes: one line "NAME KIND HASH" each.
Answers ReadAnswers(const std::string& path);
void WriteAnswers(const std::string& path, const Answers& answers);

}  // namespace spikeserve::golden
