#include "server/status_pages.h"

namespace spikeserve {

HttpResponse StatusPage(absl::string_view path, const Metrics& metrics, bool serving) {
  if (path == "/metrics") {
    return {.code = 200,
            .content_type = "text/plain; version=0.0.4; charset=utf-8",
            .body = metrics.ToText()};
  }
  if (path == "/healthz") {
    return {.code = serving ? 200 : 503, .body = serving ? "SERVING\n" : "NOT_SERVING\n"};
  }
  if (path == "/") {
    return {.code = 200,
            .content_type = "text/html; charset=utf-8",
            .body = "<!DOCTYPE html><title>spikeserve</title><h1>spikeserve " SPIKESERVE_VERSION
                    "</h1><ul><li><a href=\"/metrics\">metrics</a></li>"
                    "<li><a href=\"/healthz\">health</a></li></ul>\n"};
  }
  return {.code = 404, .body = "expected /metrics or /healthz\n"};
}

}  // namespace spikeserve
