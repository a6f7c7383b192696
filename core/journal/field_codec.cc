#include "core/journal/field_codec.h"

#include <optional>
#include <utility>

#include "core/base/cbor.h"

namespace spikeserve::codec {
absl::StatusOr<Json> ParseDocument(const std::string& bytes, absl::string_view name,
                                   absl::string_view format) {
  std::optional<Json> parsed = ParseCbor(bytes);
  if (!parsed.has_value()) {
    return absl::InvalidArgumentError(
        absl::StrCat(name, ": expected CBOR, received ", bytes.size(), " bytes of something else"));
  }
  Json& json = *parsed;
  if (!json.is_array() || json.size() != 2 || json[0] != std::string(format)) {
    return absl::InvalidArgumentError(
        absl::StrCat(name, ": expected an array of \"", format, "\" and the ", name, ", received ",
                     json.is_array() && !json.empty() ? Describe(json[0]) : Describe(json)));
  }
  return std::move(json[1]);
}

}  // namespace spikeserve::codec
