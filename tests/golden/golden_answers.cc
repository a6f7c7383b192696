#include "tests/golden/golden_answers.h"

#include <openssl/sha.h>

#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iostream>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"

namespace spikeserve::golden {

namespace fs = std::filesystem;

std::vector<std::string> ListVersions(const std::string& policies) {
  std::vector<std::string> versions;
  for (const auto& policy : fs::directory_iterator(policies)) {
    if (!policy.is_directory()) continue;
    for (const auto& version : fs::directory_iterator(policy)) {
      if (!fs::exists(version.path() / "policy.safetensors")) continue;
      versions.push_back(fs::relative(version.path(), policies).string());
    }
  }
  std::sort(versions.begin(), versions.end());
  return versions;
}

std::string HashAnswers(const std::string& path, Kind kind) {
  const std::string answers = PlayGolden(path, kind);
  unsigned char digest[SHA256_DIGEST_LENGTH];
  SHA256(reinterpret_cast<const unsigned char*>(answers.data()), answers.size(), digest);
  return absl::BytesToHexString(
      absl::string_view(reinterpret_cast<const char*>(digest), sizeof(digest)));
}

Answers HashAll(const std::string& policies) {
  Answers answers;
  for (const std::string& version : ListVersions(policies)) {
    for (const auto& [kind, name] : kKinds) {
      const std::string path = absl::StrCat(policies, "/", version, "/policy.safetensors");
      answers[absl::StrCat(version, " ", name)] = HashAnswers(path, kind);
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
