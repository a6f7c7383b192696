#include "core/cli/flag_value.h"

#include <cmath>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

absl::Status Check(bool parsed, absl::string_view expected, const std::string& text) {
  if (parsed) return absl::OkStatus();
  return absl::InvalidArgumentError(
      absl::StrCat("expected ", expected, ", received \"", text, "\""));
}

}  // namespace

absl::Status ParseFlagValue(const std::string& text, std::string* value) {
  *value = text;
  return absl::OkStatus();
}

absl::Status ParseFlagValue(const std::string& text, int32_t* value) {
  return Check(absl::SimpleAtoi(text, value), "an integer", text);
}

absl::Status ParseFlagValue(const std::string& text, int64_t* value) {
  return Check(absl::SimpleAtoi(text, value), "an integer", text);
}

absl::Status ParseFlagValue(const std::string& text, uint64_t* value) {
  return Check(absl::SimpleAtoi(text, value), "an integer of at least 0", text);
}

absl::Status ParseFlagValue(const std::string& text, float* value) {
  return Check(absl::SimpleAtof(text, value), "a number", text);
}

absl::Status ParseFlagValue(const std::string& text, double* value) {
  return Check(absl::SimpleAtod(text, value), "a number", text);
}

absl::Status ParseFlagValue(const std::string& text, bool* value) {
  return Check(absl::SimpleAtob(text, value), "true or false", text);
}

absl::Status ParseFlagValue(const std::string& text, absl::Duration* value) {
  double seconds = 0.0;
  if (absl::SimpleAtod(text, &seconds) && std::isfinite(seconds)) {  // "inf" is a duration
    *value = absl::Seconds(seconds);
    return absl::OkStatus();
  }
  return Check(absl::ParseDuration(text, value), "a duration such as 250ms, 10s or 1.5m", text);
}

std::string FlagValueText(const std::string& value) { return value; }
std::string FlagValueText(bool value) { return value ? "true" : "false"; }
std::string FlagValueText(int32_t value) { return absl::StrCat(value); }
std::string FlagValueText(int64_t value) { return absl::StrCat(value); }
std::string FlagValueText(uint64_t value) { return absl::StrCat(value); }
std::string FlagValueText(float value) { return absl::StrCat(value); }
std::string FlagValueText(double value) { return absl::StrCat(value); }
std::string FlagValueText(absl::Duration value) { return absl::FormatDuration(value); }

}  // namespace spikeserve
