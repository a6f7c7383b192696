#include "core/base/json.h"

#include <set>
#include <vector>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

// Checks a document event by event and stores only the keys of the objects that are open. Needed
// because nlohmann's parser accepts an object that contains a key twice and keeps the last value.
class StrictChecker : public nlohmann::json_sax<Json> {
 public:
  bool null() override { return CountValue(); }
  bool boolean(bool) override { return CountValue(); }
  bool number_integer(number_integer_t) override { return CountValue(); }
  bool number_unsigned(number_unsigned_t) override { return CountValue(); }
  bool number_float(number_float_t, const string_t&) override { return CountValue(); }
  bool string(string_t&) override { return CountValue(); }
  bool binary(binary_t&) override { return CountValue(); }
  bool start_object(size_t) override { return Open(); }
  bool end_object() override { return Close(); }
  bool start_array(size_t) override { return Open(); }
  bool end_array() override { return Close(); }
  bool key(string_t& name) override {
    if (keys_.back().insert(name).second) return true;
    return Fail(absl::StrCat("expected every key once, received ", Quoted(name), " twice"));
  }
  bool parse_error(size_t position, const std::string&,
                   const nlohmann::detail::exception&) override {
    return Fail(absl::StrCat("expected valid JSON in UTF-8, received an error at byte ", position));
  }

  const std::string& error() const { return error_; }

 private:
  bool Fail(std::string error) {
    error_ = std::move(error);
    return false;
  }
  bool CountValue() {
    if (++values_ <= kMaxJsonValues) return true;
    return Fail(absl::StrCat("expected at most ", kMaxJsonValues, " values, received more"));
  }
  bool Open() {
    keys_.emplace_back();
    if (keys_.size() <= kMaxJsonDepth) return CountValue();
    return Fail(absl::StrCat("expected at most ", kMaxJsonDepth, " levels, received more"));
  }
  bool Close() {
    keys_.pop_back();
    return true;
  }

  std::vector<std::set<std::string>> keys_;  // one set per open object or array
  int values_ = 0;
  std::string error_;
};

}  // namespace

absl::StatusOr<Json> ParseJsonObject(absl::string_view field, absl::string_view text) {
  // The parser treats a zero byte as the end of its input and ignores the text after it.
  if (const size_t zero = text.find('\0'); zero != text.npos) {
    return InvalidArgument(field, "valid JSON in UTF-8",
                           absl::StrCat("a zero byte at byte ", zero + 1));
  }
  StrictChecker checker;
  if (!Json::sax_parse(text, &checker)) {
    return absl::InvalidArgumentError(absl::StrCat(field, ": ", checker.error()));
  }
  Json document = Json::parse(text, /*cb=*/nullptr, /*allow_exceptions=*/false);
  if (!document.is_object()) {
    return InvalidArgument(field, "a JSON object", Describe(document));
  }
  return document;
}

std::string Quoted(absl::string_view text) {
  constexpr size_t kLongest = 80;
  return absl::StrCat("\"", absl::CHexEscape(text.substr(0, kLongest)),
                      text.size() > kLongest ? "...\"" : "\"");
}

std::string Describe(const Json& value) {
  if (value.is_object()) return "an object";
  if (value.is_array()) return absl::StrCat("an array of ", value.size());
  if (value.is_string()) return Quoted(value.get_ref<const std::string&>());
  return value.dump();
}

}  // namespace spikeserve
