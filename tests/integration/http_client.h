// A minimal HTTP client for tests.
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

// Sends GET `path` to the server at `address`, IPV4:PORT, and returns its reply. Returns an error
// if there is no connection or no valid reply; an HTTP error code is not an error.
absl::StatusOr<HttpReply> HttpGet(const std::string& address, const std::string& path);

}  // namespace spikeserve

#endif  // TESTS_INTEGRATION_HTTP_CLIENT_H_
