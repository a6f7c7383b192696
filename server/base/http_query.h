// What stands behind the question mark of an HTTP request.
#ifndef SERVER_BASE_HTTP_QUERY_H_
#define SERVER_BASE_HTTP_QUERY_H_

#include <cstdint>
#include <map>
#include <string>

#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

namespace spikeserve {

// Parameters by name, each at most once. A plain value.
class HttpQuery {
 public:
  HttpQuery() = default;

  // INVALID_ARGUMENT names a parameter that comes twice or is not one of `known`.
  static absl::StatusOr<HttpQuery> Parse(const std::multimap<std::string, std::string>& parameters,
                                         std::initializer_list<absl::string_view> known);

  // The parameter, or `otherwise` where there is none.
  std::string Get(const std::string& name, absl::string_view otherwise = "") const;

  // INVALID_ARGUMENT unless it is a whole number within [lowest, highest].
  absl::StatusOr<int64_t> GetInteger(const std::string& name, int64_t otherwise, int64_t lowest,
                                     int64_t highest) const;

 private:
  std::map<std::string, std::string> parameters_;
};

}  // namespace spikeserve

#endif  // SERVER_BASE_HTTP_QUERY_H_
