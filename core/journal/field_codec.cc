#include "core/journal/field_codec.h"

#include <optional>
#include <utility>

#include "core/base/cbor.h"
#include "core/base/status.h"

namespace spikeserve::codec {
absl::StatusOr<Json> ParseDocument(const std::string& bytes, absl::string_view name,
                                   absl::string_view format) {
  std::optional<Json> parsed = ParseCbor(bytes);
  if (!parsed.has_value()) {
    return InvalidArgument(name, "CBOR", absl::StrCat(bytes.size(), " bytes of something else"));
  }
  Json& json = *parsed;
  if (!json.is_array() || json.size() != 2 || json[0] != std::string(format)) {
    return InvalidArgument(name, absl::StrCat("an array of \"", format, "\" and the ", name),
                           json.is_array() && !json.empty() ? Describe(json[0]) : Describe(json));
  }
  return std::move(json[1]);
}

}  // namespace spikeserve::codec
