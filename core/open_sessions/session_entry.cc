#include "core/open_sessions/session_entry.h"

#include <cmath>

#include "absl/strings/ascii.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

absl::Duration PeriodOf(const std::map<std::string, std::string>& labels) {
  const auto label = labels.find(kPeriodLabel);
  double seconds = 0.0;
  if (label == labels.end() || !absl::SimpleAtod(label->second, &seconds)) return {};
  return std::isfinite(seconds) && seconds > 0.0 ? absl::Seconds(seconds) : absl::ZeroDuration();
}

std::string LabelText(const std::map<std::string, std::string>& labels) {
  std::string text;
  for (const auto& [key, value] : labels) {
    absl::StrAppend(&text, key, "=", value, absl::string_view(&kLabelEnd, 1));
  }
  absl::AsciiStrToLower(&text);
  text.shrink_to_fit();
  return text;
}

}  // namespace spikeserve
