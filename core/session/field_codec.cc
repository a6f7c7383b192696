#include "core/session/field_codec.h"

namespace spikeserve::codec {
namespace {

constexpr int kMaxDepth = 8;

// Rejects input that is nested deeper than any session, before the recursive parser reads it.
class DepthChecker : public nlohmann::json_sax<Json> {
 public:
  bool null() override { return true; }
  bool boolean(bool) override { return true; }
  bool number_integer(number_integer_t) override { return true; }
  bool number_unsigned(number_unsigned_t) override { return true; }
  bool number_float(number_float_t, const string_t&) override { return true; }
  bool string(string_t&) override { return true; }
  bool binary(binary_t&) override { return true; }
  bool key(string_t&) override { return true; }
  bool start_object(size_t) override { return ++depth_ <= kMaxDepth; }
  bool end_object() override { return --depth_, true; }
  bool start_array(size_t) override { return ++depth_ <= kMaxDepth; }
  bool end_array() override { return --depth_, true; }
  bool parse_error(size_t, const std::string&, const nlohmann::detail::exception&) override {
    return false;
  }

 private:
  int depth_ = 0;
};

}  // namespace

absl::StatusOr<Json> ParseDocument(const std::string& bytes, absl::string_view name,
                                   absl::string_view format) {
  DepthChecker checker;
  if (!Json::sax_parse(bytes, &checker, Json::input_format_t::cbor)) {
    return absl::InvalidArgumentError(
        absl::StrCat(name, ": expected CBOR, received ", bytes.size(), " bytes of something else"));
  }
  Json json = Json::from_cbor(bytes);
  if (!json.is_array() || json.size() != 2 || json[0] != std::string(format)) {
    return absl::InvalidArgumentError(
        absl::StrCat(name, ": expected an array of \"", format, "\" and the ", name, ", received ",
                     json.is_array() && !json.empty() ? Describe(json[0]) : Describe(json)));
  }
  return std::move(json[1]);
}

}  // namespace spikeserve::codec
