// Replays the seeds of a fuzz target and the inputs of folders, or writes the seeds to a folder.
//
// usage: X_replay FOLDER...   replays the seeds and every file of the folders
//        X_replay --write_seeds=FOLDER
#include <filesystem>
#include <fstream>
#include <iostream>
#include <iterator>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "tests/fuzz/fuzz_target.h"

namespace {

namespace fs = std::filesystem;

constexpr absl::string_view kWriteFlag = "--write_seeds=";

void WriteSeeds(const fs::path& folder) {
  fs::create_directories(folder);
  int number = 0;
  for (const std::string& seed : spikeserve::Seeds()) {
    std::ofstream file(folder / absl::StrCat("seed", number++), std::ios::binary);
    file << seed;
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc == 2 && absl::StartsWith(argv[1], kWriteFlag)) {
    WriteSeeds(std::string(absl::StripPrefix(argv[1], kWriteFlag)));
    return 0;
  }
  int inputs = 0;
  for (const std::string& seed : spikeserve::Seeds()) {
    spikeserve::FuzzOne(seed);
    // The beginnings of a seed are wrong in many places.
    const size_t step = seed.size() / 50 + 1;
    for (size_t size = 0; size < seed.size(); size += step) {
      spikeserve::FuzzOne(absl::string_view(seed).substr(0, size));
    }
    ++inputs;
  }
  for (int i = 1; i < argc; ++i) {
    if (!fs::is_directory(argv[i])) continue;  // nothing has failed yet
    for (const fs::directory_entry& entry : fs::directory_iterator(argv[i])) {
      std::ifstream file(entry.path(), std::ios::binary);
      spikeserve::FuzzOne(std::string(std::istreambuf_iterator<char>(file), {}));
      ++inputs;
    }
  }
  std::cout << inputs << " inputs\n";
  return inputs > 0 ? 0 : 1;
}
