#include "core/model/safetensors.h"

#include <algorithm>
#include <bit>
#include <cstring>
#include <filesystem>
#include <limits>
#include <system_error>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/file.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

static_assert(std::endian::native == std::endian::little, "the file's byte order is the machine's");

constexpr char kMetadataKey[] = "__metadata__";
constexpr uint64_t kPrefixBytes = sizeof(uint64_t);

// Returns the name of a dtype in the file.
constexpr absl::string_view Name(float) { return "F32"; }
constexpr absl::string_view Name(int8_t) { return "I8"; }
constexpr absl::string_view Name(int16_t) { return "I16"; }

// Returns the bytes of one number of a tensor.
size_t NumberBytes(const AnyTensor& tensor) {
  return std::visit([](const auto& numbers) { return sizeof(*numbers.values.data()); }, tensor);
}

// The name, the shape and the byte range of one tensor in the data section.
struct Entry {
  std::string name;
  AnyTensor tensor;  // empty, of the file's dtype
  std::vector<int> shape;
  uint64_t begin = 0;  // bytes
  uint64_t end = 0;
};

absl::Status TensorError(absl::string_view name, absl::string_view expected,
                         absl::string_view received) {
  return InvalidArgument(absl::StrCat("tensor ", Quoted(name)), expected, received);
}

absl::Status CheckSize(uint64_t size) {
  if (size >= kPrefixBytes && size <= kMaxSafetensorsFileBytes) return absl::OkStatus();
  return InvalidArgument(
      "file size", absl::StrCat(kPrefixBytes, " to ", kMaxSafetensorsFileBytes, " bytes"), size);
}

// Returns an error unless the file can be read into memory.
absl::Status CheckFile(const std::string& path) {
  std::error_code error;
  const std::filesystem::file_status file = std::filesystem::status(path, error);
  if (file.type() == std::filesystem::file_type::not_found) {
    return absl::NotFoundError("no such file");
  }
  if (error) return absl::InvalidArgumentError(error.message());
  if (!std::filesystem::is_regular_file(file)) {
    return absl::InvalidArgumentError("expected a regular file, received something else");
  }
  const uint64_t size = std::filesystem::file_size(path, error);
  if (error) return absl::InvalidArgumentError(error.message());
  return CheckSize(size);
}

// Returns the JSON text. REQUIRES: `bytes` has a prefix.
absl::StatusOr<absl::string_view> FindHeader(absl::string_view bytes) {
  uint64_t size = 0;
  std::memcpy(&size, bytes.data(), kPrefixBytes);
  const uint64_t limit = std::min(kMaxSafetensorsHeaderBytes, bytes.size() - kPrefixBytes);
  if (size > limit) {
    return InvalidArgument("header length", absl::StrCat("at most ", limit, " bytes"), size);
  }
  const absl::string_view header = bytes.substr(kPrefixBytes, size);
  if (header.empty() || header.front() != '{') {
    return InvalidArgument("header", "it to begin with \"{\"", Quoted(header.substr(0, 1)));
  }
  // The JSON parser accepts any white space at the end; safetensors allows only spaces.
  const size_t last = header.find_last_not_of(' ');
  if (header[last] != '}') {
    return InvalidArgument("header", "\"}\" and then only spaces at its end",
                           Quoted(header.substr(last, 1)));
  }
  return header;
}

absl::StatusOr<std::map<std::string, std::string>> ParseMetadata(const Json& header) {
  std::map<std::string, std::string> metadata;
  const auto found = header.find(kMetadataKey);
  if (found == header.end()) return metadata;
  if (!found->is_object()) {
    return InvalidArgument(kMetadataKey, "an object", Describe(*found));
  }
  for (const auto& [key, value] : found->items()) {
    if (!value.is_string()) {
      return InvalidArgument(absl::StrCat(kMetadataKey, ": ", Quoted(key)), "a string",
                             Describe(value));
    }
    metadata[key] = value.get<std::string>();
  }
  return metadata;
}

absl::Status ParseShape(const Json& shape, Entry* entry) {
  constexpr int kLongest = std::numeric_limits<int>::max();
  if (!shape.is_array()) return TensorError(entry->name, "a shape", Describe(shape));
  for (const Json& length : shape) {
    if (!length.is_number_unsigned() || length.get<uint64_t>() > kLongest) {
      return TensorError(entry->name, absl::StrCat("lengths from 0 to ", kLongest, " in its shape"),
                         Describe(length));
    }
    entry->shape.push_back(length.get<int>());
  }
  return absl::OkStatus();
}

// Returns the size in bytes of a tensor of this shape whose numbers have `number` bytes, or
// limit + 1 if it is larger than `limit`.
uint64_t SizeInBytes(const std::vector<int>& shape, size_t number, uint64_t limit) {
  if (std::find(shape.begin(), shape.end(), 0) != shape.end()) return 0;
  uint64_t size = number;
  for (const int length : shape) {
    if (size > limit / static_cast<uint64_t>(length)) return limit + 1;
    size *= static_cast<uint64_t>(length);
  }
  return size;
}

absl::Status ParseOffsets(const Json& offsets, uint64_t data_size, Entry* entry) {
  if (!offsets.is_array() || offsets.size() != 2 || !offsets[0].is_number_unsigned() ||
      !offsets[1].is_number_unsigned()) {
    return TensorError(entry->name, "data_offsets [begin, end]", Describe(offsets));
  }
  entry->begin = offsets[0].get<uint64_t>();
  entry->end = offsets[1].get<uint64_t>();
  if (entry->begin > entry->end || entry->end > data_size) {
    return TensorError(entry->name, absl::StrCat("data_offsets with begin <= end <= ", data_size),
                       absl::StrCat("[", entry->begin, ", ", entry->end, "]"));
  }
  const uint64_t size = SizeInBytes(entry->shape, NumberBytes(entry->tensor), data_size);
  if (size > data_size) {
    return TensorError(entry->name, absl::StrCat("at most ", data_size, " bytes"),
                       "a shape that takes more");
  }
  if (entry->end - entry->begin == size) return absl::OkStatus();
  return TensorError(entry->name, absl::StrCat(size, " bytes as its shape says"),
                     absl::StrCat("data_offsets of ", entry->end - entry->begin));
}

absl::Status ParseDtype(const Json& dtype, Entry* entry) {
  for (const AnyTensor& tensor :
       {AnyTensor(Tensor()), AnyTensor(Int8Tensor()), AnyTensor(Int16Tensor())}) {
    if (dtype != DtypeName(tensor)) continue;
    entry->tensor = tensor;
    return absl::OkStatus();
  }
  return TensorError(entry->name, "dtype \"F32\", \"I8\" or \"I16\"", Describe(dtype));
}

absl::StatusOr<Entry> ParseEntry(const std::string& name, const Json& value, uint64_t data_size) {
  if (!value.is_object()) return TensorError(name, "an object", Describe(value));
  for (const char* key : {"dtype", "shape", "data_offsets"}) {
    if (!value.contains(key)) return TensorError(name, absl::StrCat("a ", key), "none");
  }
  for (const auto& item : value.items()) {
    if (item.key() == "dtype" || item.key() == "shape" || item.key() == "data_offsets") continue;
    return TensorError(name, "dtype, shape and data_offsets", Quoted(item.key()));
  }
  Entry entry;
  entry.name = name;
  absl::Status status = ParseDtype(value["dtype"], &entry);
  if (status.ok()) status = ParseShape(value["shape"], &entry);
  if (status.ok()) status = ParseOffsets(value["data_offsets"], data_size, &entry);
  if (!status.ok()) return status;
  return entry;
}

// Returns the tensors in the order of their data. INVALID_ARGUMENT unless they cover the data
// section without overlap, hole or remainder.
absl::StatusOr<std::vector<Entry>> ParseEntries(const Json& header, uint64_t data_size) {
  std::vector<Entry> entries;
  for (const auto& [name, value] : header.items()) {
    if (name == kMetadataKey) continue;
    ASSIGN_OR_RETURN(Entry entry, ParseEntry(name, value, data_size));
    entries.push_back(std::move(entry));
  }
  std::sort(entries.begin(), entries.end(), [](const Entry& a, const Entry& b) {
    return std::tie(a.begin, a.end) < std::tie(b.begin, b.end);
  });
  uint64_t covered = 0;
  for (const Entry& entry : entries) {
    if (entry.begin != covered) {
      return TensorError(
          entry.name, absl::StrCat("its data to begin where the one before ends, at ", covered),
          absl::StrCat(entry.begin, entry.begin < covered ? " (an overlap)" : " (a hole)"));
    }
    covered = entry.end;
  }
  if (covered != data_size) {
    return InvalidArgument("data", absl::StrCat("the ", covered, " bytes of its tensors"),
                           data_size);
  }
  return entries;
}

// Copies the numbers of `entry`'s tensor from the data section.
AnyTensor CopyTensor(absl::string_view data, const Entry& entry) {
  AnyTensor tensor = entry.tensor;
  std::visit(
      [&](auto& numbers) {
        numbers = std::decay_t<decltype(numbers)>::Zeros(entry.shape);
        const uint64_t size = entry.end - entry.begin;
        if (size > 0) std::memcpy(numbers.values.data(), data.data() + entry.begin, size);
      },
      tensor);
  return tensor;
}

}  // namespace

std::string DtypeName(const AnyTensor& tensor) {
  return std::visit(
      [](const auto& numbers) {
        return std::string(Name(typename std::decay_t<decltype(numbers.values)>::value_type()));
      },
      tensor);
}

absl::StatusOr<std::string> ReadSafetensorsFile(const std::string& path) {
  RETURN_IF_ERROR(CheckFile(path));
  auto bytes = ReadFile(path);
  if (!bytes.ok()) return absl::InvalidArgumentError(bytes.status().message());
  return bytes;
}

absl::StatusOr<Safetensors> ReadSafetensors(const std::string& path) {
  ASSIGN_OR_RETURN(const auto bytes, ReadSafetensorsFile(path));
  return ParseSafetensors(bytes);
}

absl::StatusOr<Safetensors> ParseSafetensors(absl::string_view bytes) {
  RETURN_IF_ERROR(CheckSize(bytes.size()));
  ASSIGN_OR_RETURN(const absl::string_view text, FindHeader(bytes));
  ASSIGN_OR_RETURN(const Json header, ParseJsonObject("header", text));
  ASSIGN_OR_RETURN(auto metadata, ParseMetadata(header));
  const absl::string_view data = bytes.substr(kPrefixBytes + text.size());
  ASSIGN_OR_RETURN(const auto entries, ParseEntries(header, data.size()));

  Safetensors contents{.metadata = std::move(metadata), .tensors = {}};
  for (const Entry& entry : entries) contents.tensors[entry.name] = CopyTensor(data, entry);
  return contents;
}

absl::StatusOr<std::string> FormatSafetensors(const Safetensors& contents) {
  nlohmann::ordered_json header = nlohmann::ordered_json::object();
  if (!contents.metadata.empty()) header[kMetadataKey] = contents.metadata;
  std::vector<absl::string_view> pieces(2);  // the length prefix and the header, set at the end
  uint64_t offset = 0;
  const auto add = [&](const std::string& name, const AnyTensor& any) {
    std::visit(
        [&](const auto& tensor) {
          const uint64_t size = tensor.values.size() * NumberBytes(any);
          SPIKESERVE_DCHECK_EQ(size, SizeInBytes(tensor.shape, NumberBytes(any), size));
          header[name] = {{"dtype", DtypeName(any)},
                          {"shape", tensor.shape},
                          {"data_offsets", {offset, offset + size}}};
          pieces.emplace_back(reinterpret_cast<const char*>(tensor.values.data()), size);
          offset += size;
        },
        any);
  };
  for (const size_t bytes : {sizeof(float), sizeof(int16_t), sizeof(int8_t)}) {
    for (const auto& [name, tensor] : contents.tensors) {
      if (NumberBytes(tensor) == bytes) add(name, tensor);
    }
  }
  std::string text;
  try {
    text = header.dump();
  } catch (const Json::exception&) {  // dump() throws only for strings that are not UTF-8
    return absl::InvalidArgumentError("expected names and metadata in UTF-8, received other bytes");
  }
  text.resize((text.size() + kPrefixBytes - 1) / kPrefixBytes * kPrefixBytes, ' ');
  const uint64_t text_size = text.size();
  char prefix[kPrefixBytes];
  std::memcpy(prefix, &text_size, kPrefixBytes);
  pieces[0] = absl::string_view(prefix, kPrefixBytes);
  pieces[1] = text;
  return absl::StrJoin(pieces, "");
}

absl::Status WriteSafetensors(const Safetensors& contents, const std::string& path) {
  const auto bytes = FormatSafetensors(contents);
  if (!bytes.ok()) return Annotate(bytes.status(), path);
  return WriteFileAtomically(path, {*bytes});
}

}  // namespace spikeserve
