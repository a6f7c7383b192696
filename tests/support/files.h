// Helpers for tests that read and write files.
#pragma once

#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>

namespace spikeserve {

// A temporary directory that is removed, with its contents, when this object is destroyed.
class TemporaryDirectory {
 public:
  TemporaryDirectory() {
    std::string name = (std::filesystem::temp_directory_path() / "spikeserve-XXXXXX").string();
    path_ = mkdtemp(name.data());
  }
  ~TemporaryDirectory() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  TemporaryDirectory(const TemporaryDirectory&) = delete;
  TemporaryDirectory& operator=(const TemporaryDirectory&) = delete;

  const std::filesystem::path& path() const { return path_; }

 private:
  std::filesystem::path path_;
};

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
