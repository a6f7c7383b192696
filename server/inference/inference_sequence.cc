#include "server/inference/inference_sequence.h"

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/printable.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

using inference::InferParameter;
using inference::ModelInferRequest;

// The longest sequence id in bytes, which bounds what the server stores for one request.
constexpr size_t kMaxIdBytes = 256;

absl::Status BadParameter(absl::string_view name, absl::string_view expected,
                          const InferParameter& received) {
  return InvalidArgument(absl::StrCat("parameters.", name), expected,
                         Quoted(received.ShortDebugString()));
}

const InferParameter* Find(const ModelInferRequest& request, const char* name) {
  const auto it = request.parameters().find(name);
  return it == request.parameters().end() ? nullptr : &it->second;
}

absl::Status ReadFlag(const ModelInferRequest& request, const char* name, bool* flag) {
  const InferParameter* parameter = Find(request, name);
  if (parameter == nullptr) return absl::OkStatus();
  if (!parameter->has_bool_param()) return BadParameter(name, "a bool_param", *parameter);
  *flag = parameter->bool_param();
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<SequenceRequest> ReadSequence(const ModelInferRequest& request) {
  SequenceRequest sequence;
  const InferParameter* id = Find(request, "sequence_id");
  if (id != nullptr && id->has_int64_param() && id->int64_param() != 0) {
    sequence.id = absl::StrCat(id->int64_param());
  } else if (id != nullptr && !id->string_param().empty()) {
    if (id->string_param().size() > kMaxIdBytes) {
      return BadParameter("sequence_id", absl::StrCat("at most ", kMaxIdBytes, " bytes"), *id);
    }
    if (!IsPrintable(id->string_param())) {
      return BadParameter("sequence_id", "printable characters in UTF-8", *id);
    }
    sequence.id = absl::StrCat("\"", id->string_param(), "\"");
  } else if (id != nullptr && !id->has_int64_param() && !id->has_string_param()) {
    return BadParameter("sequence_id", "an int64_param or a string_param", *id);
  } else {
    return InvalidArgument(
        "parameters.sequence_id", "an integer other than 0 or a string",
        "none. A policy decides from earlier requests, so every request belongs to a sequence: "
        "send sequence_id with every request and sequence_start with the first one");
  }
  sequence.session_id = absl::StrCat("sequence:", request.model_name(), ":", sequence.id);
  absl::Status status = ReadFlag(request, "sequence_start", &sequence.start);
  status.Update(ReadFlag(request, "sequence_end", &sequence.end));
  status.Update(ReadFlag(request, "terminated", &sequence.terminated));
  status.Update(ReadFlag(request, "truncated", &sequence.truncated));
  if (!status.ok()) return status;
  if ((sequence.terminated || sequence.truncated) && !sequence.end) {
    return InvalidArgument("parameters.sequence_end", "true beside terminated or truncated",
                           "false");
  }
  if (const InferParameter* token = Find(request, kSequenceToken)) {
    if (!token->has_string_param()) {
      return BadParameter(kSequenceToken, "a string_param", *token);
    }
    sequence.token = token->string_param();
  }
  return sequence;
}

absl::StatusOr<v1::OpenSessionRequest> ReadOpening(const ModelInferRequest& request) {
  v1::OpenSessionRequest opening;
  opening.set_policy(request.model_name());
  ASSIGN_OR_RETURN(const auto version, ReadVersion(request.model_version()));
  opening.set_version(version);
  if (const InferParameter* target = Find(request, "target_return")) {
    if (!target->has_double_param() && !target->has_int64_param()) {
      return BadParameter("target_return", "a double_param or an int64_param", *target);
    }
    opening.set_target_return(target->has_double_param()
                                  ? target->double_param()
                                  : static_cast<double>(target->int64_param()));
  }
  if (const InferParameter* seed = Find(request, "seed")) {
    if (!seed->has_int64_param() && !seed->has_uint64_param()) {
      return BadParameter("seed", "an int64_param or a uint64_param", *seed);
    }
    opening.set_seed(seed->has_uint64_param() ? seed->uint64_param()
                                              : static_cast<uint64_t>(seed->int64_param()));
  }
  bool record = false;
  RETURN_IF_ERROR(ReadFlag(request, "record", &record));
  opening.set_record(record);
  return opening;
}

absl::StatusOr<int64_t> ReadVersion(const std::string& version) {
  if (version.empty()) return 0;
  int64_t number = 0;
  if (absl::SimpleAtoi(version, &number) && number >= 1) return number;
  return InvalidArgument("version", "a positive integer or nothing", Quoted(version));
}

}  // namespace spikeserve
