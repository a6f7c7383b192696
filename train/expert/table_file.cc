#include "train/expert/table_file.h"

#include <filesystem>
#include <system_error>
#include <variant>

#include "core/base/status.h"
#include "core/model/safetensors.h"

namespace spikeserve {
namespace {

constexpr char kTensor[] = "values";
constexpr char kName[] = "value_table";

}  // namespace

absl::StatusOr<std::vector<float>> ReadTable(const std::string& path, const std::string& name,
                                             const std::vector<int>& shape) {
  absl::StatusOr<Safetensors> file = ReadSafetensors(path);
  if (absl::IsNotFound(file.status())) return file.status();
  if (!file.ok()) {
    return Annotate(file.status(), path);
  }
  auto* const tensor = std::get_if<Tensor>(&file->tensors[kTensor]);
  if (file->metadata[kName] != name || tensor == nullptr || tensor->shape != shape) {
    return InvalidArgument(path, absl::StrCat("the value table ", name), "another table");
  }
  return std::move(tensor->values);
}

absl::Status WriteTable(const std::vector<float>& values, const std::string& path,
                        const std::string& name, const std::vector<int>& shape) {
  std::error_code error;
  std::filesystem::create_directories(std::filesystem::path(path).parent_path(), error);
  if (error) return absl::UnavailableError(absl::StrCat(path, ": ", error.message()));
  return WriteSafetensors({.metadata = {{kName, name}},
                           .tensors = {{kTensor, Tensor{.shape = shape, .values = values}}}},
                          path);
}

}  // namespace spikeserve
