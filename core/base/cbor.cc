#include "core/base/cbor.h"

#include <algorithm>
#include <cstddef>
#include <string>

#include "absl/strings/ascii.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

bool IsUtf8(const std::string& text) {
  if (std::all_of(text.begin(), text.end(), absl::ascii_isascii)) return true;
  try {
    Json(text).dump();
    return true;
  } catch (const Json::type_error&) {
    return false;
  }
}

// Accepts a document event by event and stores nothing of it, so that the stated length of an array
// that does not follow has no effect.
class Checker : public nlohmann::json_sax<Json> {
 public:
  bool null() override { return true; }
  bool boolean(bool) override { return true; }
  bool number_integer(number_integer_t) override { return true; }
  bool number_unsigned(number_unsigned_t) override { return true; }
  bool number_float(number_float_t, const string_t&) override { return true; }
  bool string(string_t& text) override { return IsUtf8(text); }
  bool binary(binary_t&) override { return true; }
  bool key(string_t& name) override { return IsUtf8(name); }
  bool start_object(size_t) override { return ++depth_ <= kMaxCborDepth; }
  bool end_object() override { return --depth_, true; }
  bool start_array(size_t) override { return ++depth_ <= kMaxCborDepth; }
  bool end_array() override { return --depth_, true; }
  bool parse_error(size_t, const std::string&, const nlohmann::detail::exception&) override {
    return false;
  }

 private:
  int depth_ = 0;
};

}  // namespace

std::optional<Json> ParseCbor(absl::string_view bytes) {
  Checker checker;
  const bool valid =
      Json::sax_parse(bytes.begin(), bytes.end(), &checker, Json::input_format_t::cbor);
  if (!valid) return std::nullopt;
  Json json = Json::from_cbor(bytes.begin(), bytes.end(), /*strict=*/true,
                              /*allow_exceptions=*/false);
  if (json.is_discarded()) return std::nullopt;
  return json;
}

}  // namespace spikeserve
