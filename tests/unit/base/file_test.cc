#include "core/base/file.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>

#include "tests/support/files.h"

namespace spikeserve {
namespace {

using testing::StartsWith;

using AtomicFileTest = DirectoryTest;

size_t FilesIn(const std::filesystem::path& directory) {
  return std::distance(std::filesystem::directory_iterator(directory), {});
}

TEST_F(AtomicFileTest, ReplacesTheFileAndLeavesNothingElse) {
  WriteBytes(Path("file"), "a longer old text");
  ASSERT_TRUE(WriteFileAtomically(Path("file"), {"new ", "", "text"}).ok());
  EXPECT_EQ(ReadBytes(Path("file")), "new text");
  EXPECT_EQ(FilesIn(directory()), 1u);
}

TEST_F(AtomicFileTest, EverybodyMayReadTheFile) {
  ASSERT_TRUE(WriteFileAtomically(Path("file"), {"text"}).ok());
  EXPECT_EQ(std::filesystem::status(Path("file")).permissions(),
            static_cast<std::filesystem::perms>(0644));
}

TEST_F(AtomicFileTest, ADirectoryThatIsNotThereIsAnError) {
  const std::string path = Path("nowhere") + "/file";
  const absl::Status status = WriteFileAtomically(path, {"text"});
  EXPECT_EQ(status.code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(std::string(status.message()), StartsWith(path + ": cannot create"));
}

TEST_F(AtomicFileTest, AFailedRenameLeavesNothingBehind) {
  std::filesystem::create_directory(Path("taken"));
  const absl::Status status = WriteFileAtomically(Path("taken"), {"text"});
  EXPECT_FALSE(status.ok());
  EXPECT_THAT(std::string(status.message()), StartsWith(Path("taken") + ": cannot rename"));
  EXPECT_EQ(FilesIn(directory()), 1u);
}

}  // namespace
}  // namespace spikeserve
