#include "train/evaluation/training_record.h"

#include <gtest/gtest.h>

#include "tests/support/files.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

TEST(AddLineageTest, AppendsTheEarlierRecordToItsOwnLineage) {
  ordered_json record = {{"command", "third"}};
  AddLineage(R"({"command": "second", "lineage": [{"command": "first"}]})", &record);
  EXPECT_EQ(record.dump(),
            R"({"command":"third","lineage":[{"command":"first"},{"command":"second"}]})");
}

TEST(AddLineageTest, APolicyFromNothingHasNone) {
  for (const char* earlier : {"{}", "[]", "not JSON"}) {
    ordered_json record = {{"command", "first"}};
    AddLineage(earlier, &record);
    EXPECT_FALSE(record.contains("lineage")) << earlier;
  }
}

using FileSha256Test = DirectoryTest;

TEST_F(FileSha256Test, IsTheStandardsDigest) {
  WriteBytes(Path(), "abc");
  EXPECT_EQ(*FileSha256(Path()),
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
}

TEST_F(FileSha256Test, AMissingFileIsNotFound) {
  EXPECT_EQ(FileSha256(Path("none")).status().code(), absl::StatusCode::kNotFound);
}

}  // namespace
}  // namespace spikeserve
