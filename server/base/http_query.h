// The query parameters of an HTTP request.
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Decodes %XX, and in a query '+', which is a space. Returns nullopt if a percent sign is not
// followed by two hexadecimal digits.
std::optional<std::string> PercentDecode(absl::string_view text, bool is_query = false);

// Holds the query parameters by name. Each name occurs at most once. A plain value.
class HttpQuery {
 public:
  HttpQuery() = default;

  // Returns INVALID_ARGUMENT, which names the parameter, if a parameter occurs twice or is not in
  // `known`.
  static absl::StatusOr<HttpQuery> Parse(const std::multimap<std::string, std::string>& parameters,
                                         std::initializer_list<absl::string_view> known);

  // Returns the value of `name`, or `otherwise` if the parameter is absent.
  std::string Get(const std::string& name, absl::string_view otherwise = "") const;

  // As Get, but converts the value to an integer. Returns INVALID_ARGUMENT if the value is not an
  // integer in [lowest, highest].
  absl::StatusOr<int64_t> GetInteger(const std::string& name, int64_t otherwise, int64_t lowest,
                                     int64_t highest) const;

 private:
  std::map<std::string, std::string> parameters_;
};

}  // namespace spikeserve
