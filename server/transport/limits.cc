#include "server/transport/limits.h"

#include "absl/strings/string_view.h"
#include "core/base/status.h"

namespace spikeserve {
namespace {

absl::Status CheckAtLeastOne(absl::string_view flag, int64_t value) {
  if (value >= 1) return absl::OkStatus();
  return InvalidArgument(flag, "at least 1", value);
}

absl::Status CheckPositive(absl::string_view flag, absl::Duration value) {
  if (value >= absl::Milliseconds(1)) return absl::OkStatus();
  return InvalidArgument(flag, "at least 1ms", absl::FormatDuration(value));
}

}  // namespace

absl::Status TransportLimits::Validate() const {
  absl::Status status;
  status.Update(CheckAtLeastOne("--max_streams", max_streams));
  status.Update(CheckAtLeastOne("--max_header_bytes", max_header_bytes));
  status.Update(CheckAtLeastOne("--max_headers", max_headers));
  status.Update(CheckAtLeastOne("--max_resets_per_second", max_resets_per_second));
  status.Update(CheckAtLeastOne("--max_control_frames_per_second", max_control_frames_per_second));
  status.Update(CheckAtLeastOne("--max_connection_bytes", max_connection_bytes));
  status.Update(CheckAtLeastOne("--max_tenant_bytes", max_tenant_bytes));
  status.Update(CheckAtLeastOne("--max_bytes_in_flight", max_bytes_in_flight));
  status.Update(CheckAtLeastOne("--max_connections", max_connections));
  status.Update(CheckAtLeastOne("--max_connections_per_address", max_connections_per_address));
  status.Update(CheckAtLeastOne("--max_connections_per_network", max_connections_per_network));
  status.Update(CheckAtLeastOne("--max_idle_unauthenticated", max_idle_unauthenticated));
  status.Update(CheckAtLeastOne("--max_unauthenticated_bytes", max_unauthenticated_bytes));
  status.Update(CheckPositive("--first_request_timeout", first_request_timeout));
  status.Update(CheckPositive("--request_timeout", request_timeout));
  status.Update(CheckPositive("--idle_timeout", idle_timeout));
  status.Update(CheckPositive("--write_timeout", write_timeout));
  status.Update(CheckPositive("--keepalive_interval", keepalive_interval));
  status.Update(CheckPositive("--keepalive_timeout", keepalive_timeout));
  status.Update(CheckPositive("--max_connection_age", max_connection_age));
  return status;
}

absl::Status TooManyBytesError() {
  return absl::ResourceExhaustedError(
      "--max_tenant_bytes, --max_unauthenticated_bytes, --max_connection_bytes, "
      "--max_bytes_in_flight: the requests and answers in flight of this caller, or of all, occupy "
      "as much memory as they may; try again later");
}

}  // namespace spikeserve
