#include "server/services/request_span.h"

#include <cstdint>
#include <string>

#include "absl/strings/strip.h"

namespace spikeserve {
namespace {

// Returns true for the codes that OpenTelemetry counts as errors of a server.
bool IsFaultOfServer(absl::StatusCode code) {
  switch (code) {
    case absl::StatusCode::kUnknown:
    case absl::StatusCode::kDeadlineExceeded:
    case absl::StatusCode::kUnimplemented:
    case absl::StatusCode::kInternal:
    case absl::StatusCode::kUnavailable:
    case absl::StatusCode::kDataLoss:
      return true;
    default:
      return false;
  }
}

}  // namespace

Span StartRequestSpan(Tracer& tracer, absl::string_view path, const TraceParent& parent) {
  const absl::string_view name = absl::StripPrefix(path, "/");
  Span span = tracer.Start(name, parent);
  span.Set("rpc.system.name", "grpc");
  span.Set("rpc.method", name);
  return span;
}

void FinishRequestSpan(const Credential& caller, const absl::Status& status, Span* span) {
  span->Set("rpc.response.status_code", absl::StatusCodeToString(status.code()));
  const std::string& tenant = caller.tenant()->name();
  if (!tenant.empty()) span->Set("spikeserve.tenant", tenant);
  if (IsFaultOfServer(status.code())) span->Fail(status);
  span->End();
}

}  // namespace spikeserve
