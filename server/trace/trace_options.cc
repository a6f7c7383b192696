#include "server/trace/trace_options.h"

#include <cstdint>
#include <limits>

#include "absl/algorithm/container.h"
#include "absl/status/status.h"
#include "absl/strings/ascii.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "absl/strings/strip.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "server/base/http_query.h"

namespace spikeserve {
namespace {

using Get = absl::FunctionRef<const char*(const std::string& name)>;

// A variable and its value.
struct Variable {
  std::string name;
  std::string value = "";

  bool is_set() const { return !value.empty(); }
  absl::Status Wrong(absl::string_view expected) const {
    return InvalidArgument(name, expected, Quoted(value));
  }
};

Variable Read(Get get, absl::string_view name) {
  Variable variable = {.name = absl::StrCat("OTEL_", name)};
  if (const char* value = get(variable.name)) {
    variable.value = std::string(absl::StripAsciiWhitespace(value));
  }
  return variable;
}

// Returns the variable of the exporter for traces, or else that for all signals.
Variable ReadExporter(Get get, absl::string_view name) {
  Variable traces = Read(get, absl::StrCat("EXPORTER_OTLP_TRACES_", name));
  return traces.is_set() ? traces : Read(get, absl::StrCat("EXPORTER_OTLP_", name));
}

absl::Status ReadEndpoint(const Variable& variable, TraceOptions* options) {
  const absl::Status wrong = variable.Wrong("http://HOST:PORT or https://HOST:PORT");
  absl::string_view rest = variable.value;
  options->tls = absl::ConsumePrefix(&rest, "https://");
  if (!options->tls && !absl::ConsumePrefix(&rest, "http://")) return wrong;
  absl::ConsumeSuffix(&rest, "/");
  const size_t host_end = rest.rfind(']') == rest.npos ? 0 : rest.rfind(']');  // of IPv6
  const size_t colon = rest.find(':', host_end);
  if (colon != rest.npos) {
    int port = 0;
    if (!absl::SimpleAtoi(rest.substr(colon + 1), &port) || port < 1 || port > 65535) return wrong;
    options->port = port;
    rest = rest.substr(0, colon);
  }
  if (absl::ConsumePrefix(&rest, "[") && !absl::ConsumeSuffix(&rest, "]")) return wrong;
  if (rest.empty() || rest.find_first_of("/@?#[] ") != rest.npos) return wrong;
  options->host = std::string(rest);
  return absl::OkStatus();
}

absl::Status ReadPairs(const Variable& variable, TraceOptions::Pairs* pairs) {
  for (absl::string_view item : absl::StrSplit(variable.value, ',', absl::SkipWhitespace())) {
    const std::pair<absl::string_view, absl::string_view> split =
        absl::StrSplit(item, absl::MaxSplits('=', 1));
    auto value = PercentDecode(absl::StripAsciiWhitespace(split.second));
    const absl::string_view key = absl::StripAsciiWhitespace(split.first);
    if (!absl::StrContains(item, '=') || key.empty() || !value.has_value()) {
      return variable.Wrong("KEY=VALUE,KEY=VALUE with %XX for special characters");
    }
    pairs->emplace_back(key, *std::move(value));
  }
  return absl::OkStatus();
}

// Headers may carry secrets, so that an error does not repeat them.
absl::Status ReadHeaders(const Variable& variable, TraceOptions::Pairs* headers) {
  const absl::Status wrong = absl::InvalidArgumentError(
      absl::StrCat(variable.name,
                   ": expected NAME=VALUE,NAME=VALUE with names of letters, digits and '-', and "
                   "values without control characters"));
  if (!ReadPairs(variable, headers).ok()) return wrong;
  for (auto& [name, value] : *headers) {
    absl::AsciiStrToLower(&name);
    const auto is_of_name = [](unsigned char c) {
      return absl::ascii_isalnum(c) || c == '-' || c == '_';
    };
    if (!absl::c_all_of(name, is_of_name) || !absl::c_all_of(value, absl::ascii_isprint)) {
      return wrong;
    }
  }
  return absl::OkStatus();
}

absl::Status ReadNumber(const Variable& variable, int64_t least, int64_t* number) {
  if (!variable.is_set()) return absl::OkStatus();
  if (!absl::SimpleAtoi(variable.value, number) || *number < least ||
      *number > std::numeric_limits<int32_t>::max()) {
    return variable.Wrong(absl::StrCat("a whole number of at least ", least));
  }
  return absl::OkStatus();
}

absl::Status ReadMilliseconds(const Variable& variable, absl::Duration* duration) {
  int64_t milliseconds = absl::ToInt64Milliseconds(*duration);
  auto status = ReadNumber(variable, /*least=*/1, &milliseconds);
  *duration = absl::Milliseconds(milliseconds);
  return status;
}

absl::Status ReadSampler(Get get, TraceOptions* options) {
  const Variable sampler = Read(get, "TRACES_SAMPLER");
  absl::string_view kind = sampler.value;
  if (kind.empty()) return absl::OkStatus();
  options->follows_parent = absl::ConsumePrefix(&kind, "parentbased_");
  if (kind == "always_on") {
    options->ratio = 1.0;
  } else if (kind == "always_off") {
    options->ratio = 0.0;
  } else if (kind == "traceidratio") {
    const Variable argument = Read(get, "TRACES_SAMPLER_ARG");
    options->ratio = 1.0;
    if (argument.is_set() && (!absl::SimpleAtod(argument.value, &options->ratio) ||
                              !(options->ratio >= 0.0 && options->ratio <= 1.0))) {
      return argument.Wrong("a share of 0 to 1");
    }
  } else {
    return sampler.Wrong(
        "always_on, always_off or traceidratio, or one of these with parentbased_ before it");
  }
  return absl::OkStatus();
}

absl::Status ReadPropagators(const Variable& variable, TraceOptions* options) {
  if (!variable.is_set()) return absl::OkStatus();
  options->reads_parent = false;
  for (absl::string_view name : absl::StrSplit(variable.value, ',', absl::SkipWhitespace())) {
    name = absl::StripAsciiWhitespace(name);
    if (name == "tracecontext") options->reads_parent = true;
    if (name != "tracecontext" && name != "baggage" && name != "none") {
      return variable.Wrong("tracecontext, baggage or none");
    }
  }
  return absl::OkStatus();
}

// Checks what this exporter supports only one value of.
absl::Status CheckExporter(Get get) {
  if (const Variable protocol = ReadExporter(get, "PROTOCOL");
      protocol.is_set() && protocol.value != "grpc") {
    return protocol.Wrong("grpc");
  }
  if (const Variable compression = ReadExporter(get, "COMPRESSION");
      compression.is_set() && compression.value != "none") {
    return compression.Wrong("none");
  }
  return absl::OkStatus();
}

absl::Status ReadBatches(Get get, TraceOptions* options) {
  auto queue = static_cast<int64_t>(options->queue), batch = static_cast<int64_t>(options->batch);
  auto status = ReadNumber(Read(get, "BSP_MAX_QUEUE_SIZE"), /*least=*/1, &queue);
  if (batch > queue) batch = queue;
  const Variable size = Read(get, "BSP_MAX_EXPORT_BATCH_SIZE");
  if (status.ok()) status = ReadNumber(size, /*least=*/1, &batch);
  if (status.ok() && batch > queue) {
    return size.Wrong(absl::StrCat("at most OTEL_BSP_MAX_QUEUE_SIZE, ", queue));
  }
  options->queue = static_cast<size_t>(queue);
  options->batch = static_cast<size_t>(batch);
  if (status.ok()) status = ReadMilliseconds(Read(get, "BSP_SCHEDULE_DELAY"), &options->delay);
  return status;
}

absl::Status ReadResource(Get get, TraceOptions* options) {
  RETURN_IF_ERROR(ReadPairs(Read(get, "RESOURCE_ATTRIBUTES"), &options->resource));
  const Variable service = Read(get, "SERVICE_NAME");
  std::erase_if(options->resource, [&](const auto& pair) {
    if (pair.first != "service.name") return false;
    options->service_name = pair.second;
    return true;
  });
  if (service.is_set()) options->service_name = service.value;
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<TraceOptions> ReadTraceOptions(Get get) {
  TraceOptions options;
  const Variable disabled = Read(get, "SDK_DISABLED");
  if (absl::AsciiStrToLower(disabled.value) == "true") return options;
  if (disabled.is_set() && absl::AsciiStrToLower(disabled.value) != "false") {
    return disabled.Wrong("true or false");
  }
  const Variable exporter = Read(get, "TRACES_EXPORTER");
  if (exporter.value == "none") return options;
  if (exporter.is_set() && exporter.value != "otlp") return exporter.Wrong("otlp or none");
  const Variable endpoint = ReadExporter(get, "ENDPOINT");
  if (endpoint.is_set()) {
    RETURN_IF_ERROR(ReadEndpoint(endpoint, &options));
  } else if (exporter.is_set()) {
    options.host = "localhost";
  } else {
    return options;
  }
  RETURN_IF_ERROR(CheckExporter(get));
  RETURN_IF_ERROR(ReadHeaders(ReadExporter(get, "HEADERS"), &options.headers));
  RETURN_IF_ERROR(ReadMilliseconds(ReadExporter(get, "TIMEOUT"), &options.timeout));
  RETURN_IF_ERROR(ReadResource(get, &options));
  RETURN_IF_ERROR(ReadSampler(get, &options));
  RETURN_IF_ERROR(ReadPropagators(Read(get, "PROPAGATORS"), &options));
  RETURN_IF_ERROR(ReadBatches(get, &options));
  options.ca = ReadExporter(get, "CERTIFICATE").value;
  options.certificate = ReadExporter(get, "CLIENT_CERTIFICATE").value;
  options.key = ReadExporter(get, "CLIENT_KEY").value;
  return options;
}

}  // namespace spikeserve
