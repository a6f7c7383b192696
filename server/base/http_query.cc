#include "server/base/http_query.h"

#include <algorithm>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/hex.h"
#include "core/base/json.h"
#include "core/base/status.h"

namespace spikeserve {

std::optional<std::string> PercentDecode(absl::string_view text, bool is_query) {
  std::string decoded;
  decoded.reserve(text.size());
  for (size_t i = 0; i < text.size(); ++i) {
    if (text[i] == '%') {
      const std::optional<std::string> byte = ParseHex(text.substr(i + 1, 2));
      if (!byte.has_value() || byte->empty()) return std::nullopt;
      decoded += *byte;
      i += 2;
    } else {
      decoded += is_query && text[i] == '+' ? ' ' : text[i];
    }
  }
  return decoded;
}

absl::StatusOr<HttpQuery> HttpQuery::Parse(
    const std::multimap<std::string, std::string>& parameters,
    std::initializer_list<absl::string_view> known) {
  HttpQuery parsed;
  for (const auto& [name, value] : parameters) {
    if (std::find(known.begin(), known.end(), name) == known.end()) {
      return InvalidArgument("query", absl::StrCat("parameters among ", absl::StrJoin(known, ", ")),
                             Quoted(name));
    }
    if (!parsed.parameters_.emplace(name, value).second) {
      return InvalidArgument(name, "once", "twice");
    }
  }
  return parsed;
}

std::string HttpQuery::Get(const std::string& name, absl::string_view otherwise) const {
  const auto it = parameters_.find(name);
  return it == parameters_.end() ? std::string(otherwise) : it->second;
}

absl::StatusOr<int64_t> HttpQuery::GetInteger(const std::string& name, int64_t otherwise,
                                              int64_t lowest, int64_t highest) const {
  const auto it = parameters_.find(name);
  if (it == parameters_.end()) return otherwise;
  int64_t value = 0;
  if (!absl::SimpleAtoi(it->second, &value) || value < lowest || value > highest) {
    return InvalidArgument(name, absl::StrCat("a whole number from ", lowest, " to ", highest),
                           Quoted(it->second));
  }
  return value;
}

}  // namespace spikeserve
