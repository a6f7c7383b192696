// One HTTP GET, for tests.
#ifndef TESTS_INTEGRATION_HTTP_CLIENT_H_
#define TESTS_INTEGRATION_HTTP_CLIENT_H_

#include <string>

#include "absl/status/statusor.h"

namespace spikeserve {

struct HttpReply {
  int code = 0;
  std::string headers;
  std::string body;
};

// GETs http://`address``path`, where `address` is IPV4:PORT.
absl::StatusOr<HttpReply> HttpGet(const std::string& address, const std::string& path);

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_HTTP_CLIENT_H_
