// Helpers for tests that read and write files.
#pragma once

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>

#include "tests/support/temporary_directory.h"

namespace spikeserve {

// A fixture that gives each test an empty directory, which is removed when the test ends.
class DirectoryTest : public testing::Test {
 protected:
  std::string Path(const std::string& name = "policy.safetensors") const {
    return directory() / name;
  }
  const std::filesystem::path& directory() const { return directory_.path(); }

 private:
  const TemporaryDirectory directory_;
};

inline void WriteBytes(const std::string& path, const std::string& bytes) {
  std::ofstream(path, std::ios::binary) << bytes;
}

inline std::string ReadBytes(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return std::string(std::istreambuf_iterator<char>(file), {});
}

// Returns the bytes of a safetensors file: the length of `header` as a little-endian 64-bit
// integer, then `header` and `data` unchanged.
inline std::string Container(const std::string& header, const std::string& data) {
  std::string bytes;
  for (int byte = 0; byte < 8; ++byte) {
    bytes.push_back(static_cast<char>(header.size() >> (8 * byte)));
  }
  return bytes + header + data;
}

}  // namespace spikeserve
