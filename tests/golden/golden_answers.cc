#include "tests/golden/golden_answers.h"

#include <openssl/sha.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iostream>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"

namespace spikeserve::golden {

namespace fs = std::filesystem;

std::vector<Subject> AllSubjects(const std::string& policies) {
  std::vector<Subject> subjects = RandomSubjects();
  for (const auto& policy : fs::directory_iterator(policies)) {
    if (!policy.is_directory()) continue;
    for (const auto& version : fs::directory_iterator(policy)) {
      const fs::path file = version.path() / "policy.safetensors";
      if (!fs::exists(file)) continue;
      subjects.push_back(
          {fs::relative(version.path(), policies).string(), ReadPolicy(file.string())});
    }
  }
  return subjects;
}

std::string HashAnswers(const Policy& policy, Kind kind) {
  const std::string answers = PlayGolden(policy, kind);
  unsigned char digest[SHA256_DIGEST_LENGTH];
  SHA256(reinterpret_cast<const unsigned char*>(answers.data()), answers.size(), digest);
  return absl::BytesToHexString(
      absl::string_view(reinterpret_cast<const char*>(digest), sizeof(digest)));
}

Answers HashAll(const std::string& policies) {
  Answers answers;
  for (const Subject& subject : AllSubjects(policies)) {
    for (const auto& [kind, name] : kKinds) {
      answers[absl::StrCat(subject.name, " ", name)] = HashAnswers(subject.policy, kind);
    }
  }
  return answers;
}

Answers ReadAnswers(const std::string& path) {
  Answers answers;
  std::ifstream file(path);
  for (std::string version, kind, hash; file >> version >> kind >> hash;) {
    answers[absl::StrCat(version, " ", kind)] = hash;
  }
  return answers;
}

void WriteAnswers(const std::string& path, const Answers& answers) {
  std::ofstream file(path);
  for (const auto& [name, hash] : answers) file << name << ' ' << hash << '\n';
  file.close();
  if (file.good()) return;
  std::cerr << path << ": cannot be written\n";
  std::abort();
}

}  // namespace spikeserve::golden
