#include "core/model/safetensors.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/stat.h>

#include <string>
#include <vector>

#include "tests/support/files.h"

namespace spikeserve {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Pair;

using SafetensorsTest = DirectoryTest;

// The bytes of the little-endian float32 numbers 1, -2 and 0.5.
const std::string kOne("\x00\x00\x80\x3f", 4);
const std::string kMinusTwo("\x00\x00\x00\xc0", 4);
const std::string kHalf("\x00\x00\x00\x3f", 4);

TEST_F(SafetensorsTest, ReadsAFileWrittenByHand) {
  WriteBytes(Path(), Container(R"({"__metadata__":{"by":"hand"},)"
                               R"("b":{"dtype":"F32","shape":[2,1],"data_offsets":[0,8]},)"
                               R"("a":{"dtype":"F32","shape":[],"data_offsets":[8,12]},)"
                               R"("none":{"dtype":"F32","shape":[0,3],"data_offsets":[8,8]}}   )",
                               kOne + kMinusTwo + kHalf));
  const auto contents = ReadSafetensors(Path());
  ASSERT_TRUE(contents.ok()) << contents.status();
  EXPECT_THAT(contents->metadata, ElementsAre(Pair("by", "hand")));
  ASSERT_EQ(contents->tensors.size(), 3u);
  const auto floats = [&](const char* name) {
    return std::get<Tensor>(contents->tensors.at(name));
  };
  EXPECT_THAT(floats("b").shape, ElementsAre(2, 1));
  EXPECT_THAT(floats("b").values, ElementsAre(1.0f, -2.0f));
  EXPECT_THAT(floats("a").shape, IsEmpty());
  EXPECT_THAT(floats("a").values, ElementsAre(0.5f));
  EXPECT_THAT(floats("none").values, IsEmpty());
}

TEST_F(SafetensorsTest, ReadsIntegers) {
  WriteBytes(Path(), Container(R"({"w":{"dtype":"I16","shape":[2],"data_offsets":[0,4]},)"
                               R"("b":{"dtype":"I8","shape":[3],"data_offsets":[4,7]}})",
                               std::string("\xff\x7f\x00\x80\x01\x80\x7f", 7)));
  const auto contents = ReadSafetensors(Path());
  ASSERT_TRUE(contents.ok()) << contents.status();
  EXPECT_THAT(std::get<Int16Tensor>(contents->tensors.at("w")).values, ElementsAre(32767, -32768));
  EXPECT_THAT(std::get<Int8Tensor>(contents->tensors.at("b")).values, ElementsAre(1, -128, 127));
}

TEST_F(SafetensorsTest, ReadsAFileWithoutTensors) {
  WriteBytes(Path(), Container("{}", ""));
  const auto contents = ReadSafetensors(Path());
  ASSERT_TRUE(contents.ok()) << contents.status();
  EXPECT_THAT(contents->tensors, IsEmpty());
}

TEST_F(SafetensorsTest, WritesTheReferenceLayout) {
  const Safetensors contents = {.metadata = {{"by", "us"}},
                                .tensors = {{"b", Tensor{.shape = {2, 1}, .values = {1.0f, -2.0f}}},
                                            {"a", Tensor{.shape = {}, .values = {0.5f}}}}};
  ASSERT_TRUE(WriteSafetensors(contents, Path()).ok());
  std::string header = R"({"__metadata__":{"by":"us"},)"
                       R"("a":{"dtype":"F32","shape":[],"data_offsets":[0,4]},)"
                       R"("b":{"dtype":"F32","shape":[2,1],"data_offsets":[4,12]}})";
  while (header.size() % 8 != 0) header.push_back(' ');
  EXPECT_EQ(ReadBytes(Path()), Container(header, kHalf + kOne + kMinusTwo));
}

TEST_F(SafetensorsTest, WritesWideTensorsFirst) {
  const Safetensors contents = {.metadata = {},
                                .tensors = {{"a", Int8Tensor{.shape = {2}, .values = {1, -1}}},
                                            {"b", Int16Tensor{.shape = {1}, .values = {-2}}},
                                            {"c", Tensor{.shape = {1}, .values = {1.0f}}},
                                            {"d", Int8Tensor{.shape = {1}, .values = {127}}}}};
  ASSERT_TRUE(WriteSafetensors(contents, Path()).ok());
  std::string header = R"({"c":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},)"
                       R"("b":{"dtype":"I16","shape":[1],"data_offsets":[4,6]},)"
                       R"("a":{"dtype":"I8","shape":[2],"data_offsets":[6,8]},)"
                       R"("d":{"dtype":"I8","shape":[1],"data_offsets":[8,9]}})";
  while (header.size() % 8 != 0) header.push_back(' ');
  EXPECT_EQ(ReadBytes(Path()), Container(header, kOne + "\xfe\xff\x01\xff\x7f"));
}

TEST_F(SafetensorsTest, MissingFileIsNotFound) {
  const absl::Status status = ReadSafetensors(Path()).status();
  EXPECT_EQ(status.code(), absl::StatusCode::kNotFound);
  EXPECT_EQ(status.message(), "no such file");
}

TEST_F(SafetensorsTest, RefusesWhatIsNotARegularFile) {
  EXPECT_THAT(std::string(ReadSafetensors(directory()).status().message()),
              HasSubstr("expected a regular file"));
  // Opening a pipe without a writer would block forever.
  ASSERT_EQ(mkfifo(Path().c_str(), 0600), 0);
  EXPECT_EQ(ReadSafetensors(Path()).status().code(), absl::StatusCode::kInvalidArgument);
}

TEST_F(SafetensorsTest, RefusesAFileBeyondTheLimit) {
  WriteBytes(Path(), Container("{}", ""));
  std::filesystem::resize_file(Path(), kMaxSafetensorsFileBytes + 1);  // sparse
  EXPECT_THAT(std::string(ReadSafetensors(Path()).status().message()),
              HasSubstr("file size: expected 8 to 4294967296 bytes, received 4294967297"));
}

TEST_F(SafetensorsTest, RefusesABrokenFrame) {
  const std::string entry = R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}})";
  const struct {
    std::string bytes;
    std::string fragment;
  } cases[] = {
      {"", "file size: expected 8 to 4294967296 bytes, received 0"},
      {"1234567", "file size: expected 8 to 4294967296 bytes, received 7"},
      {std::string(8, '\0'), "header: expected it to begin with \"{\", received \"\""},
      {std::string(8, '\xff') + "{}",
       "header length: expected at most 2 bytes, received 18446744073709551615"},
      {std::string("\x03\0\0\0\0\0\0\0{}", 10),
       "header length: expected at most 2 bytes, received 3"},
      {Container(" {}", ""), "header: expected it to begin with \"{\", received \" \""},
      {Container("[]", ""), "header: expected it to begin with \"{\", received \"[\""},
      {Container("{}\n", ""), "header: expected \"}\" and then only spaces at its end"},
      {Container("{} x", ""), "header: expected \"}\" and then only spaces at its end"},
      {Container("{} }", ""), "header: expected valid JSON in UTF-8"},
      {Container(std::string("{}\0}", 4), ""), "header: expected valid JSON in UTF-8"},
      {Container("{\"\xc3\x28\":{}}", ""), "header: expected valid JSON in UTF-8"},
      {Container("{\"a\" 1}", ""), "header: expected valid JSON in UTF-8"},
      {Container(entry, ""), "data_offsets with begin <= end <= 0, received [0, 4]"},
      {Container(entry, "123"), "data_offsets with begin <= end <= 3, received [0, 4]"},
      {Container(entry, "12345"), "data: expected the 4 bytes of its tensors, received 5"},
      {Container("{}", "1"), "data: expected the 0 bytes of its tensors, received 1"},
  };
  for (const auto& c : cases) {
    WriteBytes(Path(), c.bytes);
    const absl::Status status = ReadSafetensors(Path()).status();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << c.fragment;
    EXPECT_THAT(std::string(status.message()), HasSubstr(c.fragment));
  }
}

TEST_F(SafetensorsTest, RefusesAHeaderBeyondTheLimit) {
  const uint64_t size = kMaxSafetensorsHeaderBytes + 1;
  std::string bytes;
  for (int byte = 0; byte < 8; ++byte) bytes.push_back(static_cast<char>(size >> (8 * byte)));
  WriteBytes(Path(), bytes + "{}");
  std::filesystem::resize_file(Path(), 8 + size);  // sparse
  EXPECT_THAT(std::string(ReadSafetensors(Path()).status().message()),
              HasSubstr("header length: expected at most 100000000 bytes, received 100000001"));
}

TEST_F(SafetensorsTest, EveryTruncationIsRefused) {
  const std::string whole =
      Container(R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}})", kOne + kHalf);
  for (size_t size = 0; size < whole.size(); ++size) {
    WriteBytes(Path(), whole.substr(0, size));
    EXPECT_EQ(ReadSafetensors(Path()).status().code(), absl::StatusCode::kInvalidArgument) << size;
  }
}

class SafetensorsHeaderTest : public DirectoryTest {
 protected:
  struct Refusal {
    std::string header;
    std::string fragment;  // of the message
  };

  // Writes each header, followed by 16 bytes of data, and expects that the file is refused.
  void ExpectRefused(const std::vector<Refusal>& refusals) {
    for (const Refusal& refusal : refusals) {
      WriteBytes(Path(), Container(refusal.header, kOne + kOne + kOne + kOne));
      const absl::Status status = ReadSafetensors(Path()).status();
      EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << refusal.header;
      EXPECT_THAT(std::string(status.message()), HasSubstr(refusal.fragment));
    }
  }

  const std::string a = R"("a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]})";
};

TEST_F(SafetensorsHeaderTest, RefusesBrokenEntries) {
  ExpectRefused({
      {"{" + a + "," + a + "}", "every key once, received \"a\" twice"},
      {R"({"a":{"dtype":"F32","dtype":"F32","shape":[4],"data_offsets":[0,16]}})",
       "every key once, received \"dtype\" twice"},
      {R"({"__metadata__":[]})", "__metadata__: expected an object, received an array of 0"},
      {R"({"__metadata__":{"k":1}})", "__metadata__: \"k\": expected a string, received 1"},
      {R"({"a":3})", "tensor \"a\": expected an object, received 3"},
      {R"({"a":{"shape":[4],"data_offsets":[0,16]}})", "expected a dtype, received none"},
      {R"({"a":{"dtype":"F32","data_offsets":[0,16]}})", "expected a shape, received none"},
      {R"({"a":{"dtype":"F32","shape":[4]}})", "expected a data_offsets, received none"},
      {R"({"a":{"dtype":"F32","shape":[4],"data_offsets":[0,16],"x":1}})",
       "expected dtype, shape and data_offsets, received \"x\""},
      {R"({"a":{"dtype":"F64","shape":[2],"data_offsets":[0,16]}})",
       "tensor \"a\": expected dtype \"F32\", \"I8\" or \"I16\", received \"F64\""},
      {R"({"a":{"dtype":32,"shape":[4],"data_offsets":[0,16]}})",
       "dtype \"F32\", \"I8\" or \"I16\", received 32"},
      {R"({"a":{"dtype":"F32","shape":4,"data_offsets":[0,16]}})", "expected a shape, received 4"},
      {R"({"a":{"dtype":"F32","shape":[-4],"data_offsets":[0,16]}})", "in its shape, received -4"},
      {R"({"a":{"dtype":"F32","shape":[4.0],"data_offsets":[0,16]}})",
       "in its shape, received 4.0"},
      {R"({"a":{"dtype":"F32","shape":[2147483648],"data_offsets":[0,16]}})",
       "lengths from 0 to 2147483647 in its shape, received 2147483648"},
      {R"({"a":{"dtype":"F32","shape":[99999999999999999999],"data_offsets":[0,16]}})",
       "in its shape, received 1e+20"},
      // 4 * 65536^4 is 2^66, which overflows to 0 in 64 bits.
      {R"({"a":{"dtype":"F32","shape":[65536,65536,65536,65536],"data_offsets":[0,0]}})",
       "expected at most 16 bytes, received a shape that takes more"},
      {R"({"a":{"dtype":"F32","shape":[5],"data_offsets":[0,16]}})",
       "expected at most 16 bytes, received a shape that takes more"},
      {R"({"a":{"dtype":"F32","shape":[3],"data_offsets":[0,16]}})",
       "expected 12 bytes as its shape says, received data_offsets of 16"},
      {R"({"a":{"dtype":"I16","shape":[4],"data_offsets":[0,16]}})",
       "expected 8 bytes as its shape says, received data_offsets of 16"},
      {R"({"a":{"dtype":"I8","shape":[17],"data_offsets":[0,16]}})",
       "expected at most 16 bytes, received a shape that takes more"},
  });
}

TEST_F(SafetensorsHeaderTest, RefusesBrokenOffsets) {
  ExpectRefused({
      {R"({"a":{"dtype":"F32","shape":[4],"data_offsets":16}})",
       "expected data_offsets [begin, end], received 16"},
      {R"({"a":{"dtype":"F32","shape":[4],"data_offsets":[0,8,16]}})",
       "expected data_offsets [begin, end], received an array of 3"},
      {R"({"a":{"dtype":"F32","shape":[4],"data_offsets":[-16,0]}})",
       "expected data_offsets [begin, end], received an array of 2"},
      {R"({"a":{"dtype":"F32","shape":[4],"data_offsets":[16,0]}})",
       "expected data_offsets with begin <= end <= 16, received [16, 0]"},
      {R"({"a":{"dtype":"F32","shape":[4],"data_offsets":[4,20]}})",
       "expected data_offsets with begin <= end <= 16, received [4, 20]"},
      {R"({"a":{"dtype":"F32","shape":[4],"data_offsets":[18446744073709551612,12]}})",
       "expected data_offsets with begin <= end <= 16, received [18446744073709551612, 12]"},
      {"{" + a + R"(,"b":{"dtype":"F32","shape":[3],"data_offsets":[4,16]}})",
       "tensor \"b\": expected its data to begin where the one before ends, at 8, received 4 (an "
       "overlap)"},
      {"{" + a + R"(,"b":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}})",
       "received 0 (an overlap)"},
      {"{" + a + R"(,"b":{"dtype":"F32","shape":[1],"data_offsets":[12,16]}})",
       "tensor \"b\": expected its data to begin where the one before ends, at 8, received 12 (a "
       "hole)"},
      {R"({"b":{"dtype":"F32","shape":[3],"data_offsets":[4,16]}})",
       "expected its data to begin where the one before ends, at 0, received 4 (a hole)"},
      {"{" + a + "}", "data: expected the 8 bytes of its tensors, received 16"},
  });
}

TEST_F(SafetensorsTest, WriterRefusesMetadataThatIsNotUtf8) {
  const absl::Status status =
      WriteSafetensors({.metadata = {{"k", "\xff"}}, .tensors = {}}, Path());
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(status.message(),
            Path() + ": expected names and metadata in UTF-8, received other bytes");
  EXPECT_TRUE(std::filesystem::is_empty(directory()));
}

}  // namespace
}  // namespace spikeserve
