#include "server/inference/inference_json.h"

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>
#include <map>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/base/json.h"
#include "core/base/json_object.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/contract/dcheck.h"
#include "nlohmann/json.hpp"
#include "proto/json.h"

namespace spikeserve {

// Refers to a member of a body, which is not copied: it may be long.
struct Member {
  const nlohmann::json* json = nullptr;  // null: absent
};

static absl::Status ReadJson(absl::string_view /*field*/, const nlohmann::json& value,
                             Member* result) {
  result->json = &value;
  return absl::OkStatus();
}

namespace {

using Json = nlohmann::json;
using OrderedJson = nlohmann::ordered_json;
using Parameters = google::protobuf::Map<std::string, inference::InferParameter>;

constexpr char kBinarySize[] = "binary_data_size";
constexpr char kBinaryOutput[] = "binary_data";
constexpr char kBinaryOutputs[] = "binary_data_output";
constexpr int kMostDimensions = 8;

absl::Status ReadParameter(const std::string& field, const Json& value,
                           inference::InferParameter* parameter) {
  if (value.is_boolean()) {
    parameter->set_bool_param(value.get<bool>());
  } else if (value.is_number_unsigned() &&
             value.get<uint64_t>() > uint64_t{std::numeric_limits<int64_t>::max()}) {
    parameter->set_uint64_param(value.get<uint64_t>());
  } else if (value.is_number_integer()) {
    parameter->set_int64_param(value.get<int64_t>());
  } else if (value.is_number()) {
    parameter->set_double_param(value.get<double>());
  } else if (value.is_string()) {
    parameter->set_string_param(value.get_ref<const std::string&>());
  } else {
    return UnexpectedJson(field, "true, false, a number or a string", value);
  }
  return absl::OkStatus();
}

// Reads all members of `json` but `reserved`, which it stores in `value` unless it is null.
absl::Status ReadParameters(const std::string& field, const std::map<std::string, Member>& json,
                            const char* reserved, Member* value, Parameters* parameters) {
  for (const auto& [name, member] : json) {
    if (name == reserved) {
      if (!member.json->is_null()) *value = member;
      continue;
    }
    RETURN_IF_ERROR(
        ReadParameter(absl::StrCat(field, ".", name), *member.json, &(*parameters)[name]));
  }
  return absl::OkStatus();
}

// Appends the numbers of `json`, an array of numbers or of such arrays, as the bytes of FP32.
absl::Status AppendFloats(const std::string& field, const Json& json, int depth,
                          std::string* bytes) {
  if (!json.is_array()) return UnexpectedJson(field, "an array", json);
  if (depth > kMostDimensions) {
    return InvalidArgument(field, absl::StrCat("at most ", kMostDimensions, " dimensions"), "more");
  }
  for (size_t i = 0; i < json.size(); ++i) {
    float number = 0.0f;
    if (!json[i].is_array() && ReadJson(field, json[i], &number).ok()) {
      bytes->append(reinterpret_cast<const char*>(&number), sizeof(number));
      continue;
    }
    // The name of an element is built only where it is needed: arrays are long.
    const std::string element = absl::StrCat(field, "[", i, "]");
    RETURN_IF_ERROR(json[i].is_array() ? AppendFloats(element, json[i], depth + 1, bytes)
                                       : ReadJson(element, json[i], &number));
  }
  return absl::OkStatus();
}

class InferReader {
 public:
  // `bytes` are those behind the JSON object.
  explicit InferReader(absl::string_view bytes) : bytes_(bytes) {}

  absl::StatusOr<HttpInferRequest> Read(const Json& json) {
    std::map<std::string, Member> parameters;
    std::vector<Member> inputs;
    std::vector<Member> outputs;
    JsonObject object("", json);
    object.Optional("id", request_.message.mutable_id());
    object.Optional("parameters", &parameters);
    object.Required("inputs", &inputs);
    object.Optional("outputs", &outputs);
    RETURN_IF_ERROR(object.Finish());
    Member binary;
    auto status = ReadParameters("parameters", parameters, kBinaryOutputs, &binary,
                                 request_.message.mutable_parameters());
    if (status.ok() && binary.json != nullptr) {
      status = ReadJson(absl::StrCat("parameters.", kBinaryOutputs), *binary.json,
                        &request_.outputs.by_default);
    }
    for (size_t i = 0; i < inputs.size() && status.ok(); ++i) {
      status = ReadInput(absl::StrCat("inputs[", i, "]"), *inputs[i].json);
    }
    for (size_t i = 0; i < outputs.size() && status.ok(); ++i) {
      status = ReadOutput(absl::StrCat("outputs[", i, "]"), *outputs[i].json);
    }
    if (!status.ok()) return status;
    if (!bytes_.empty()) {
      return InvalidArgument(
          "body",
          absl::StrCat("as many bytes behind its JSON as the inputs' ", kBinarySize, " say"),
          absl::StrCat(bytes_.size(), " more"));
    }
    return std::move(request_);
  }

 private:
  absl::Status ReadInput(const std::string& field, const Json& json) {
    auto& tensor = *request_.message.add_inputs();
    std::string& raw = *request_.message.add_raw_input_contents();
    std::vector<int64_t> shape;
    std::map<std::string, Member> parameters;
    Member data;
    JsonObject object(field, json);
    object.Required("name", tensor.mutable_name());
    object.Required("datatype", tensor.mutable_datatype());
    object.Required("shape", &shape);
    object.Optional("parameters", &parameters);
    object.Optional("data", &data);
    RETURN_IF_ERROR(object.Finish());
    tensor.mutable_shape()->Add(shape.begin(), shape.end());
    Member size;
    RETURN_IF_ERROR(ReadParameters(absl::StrCat(field, ".parameters"), parameters, kBinarySize,
                                   &size, tensor.mutable_parameters()));
    if ((size.json == nullptr) == (data.json == nullptr)) {
      return InvalidArgument(field, absl::StrCat("either data or parameters.", kBinarySize),
                             data.json != nullptr ? "both" : "neither");
    }
    if (size.json != nullptr) {
      return TakeBytes(absl::StrCat(field, ".parameters.", kBinarySize), *size.json, &raw);
    }
    // The handler refuses other types by name.
    if (tensor.datatype() != "FP32") return absl::OkStatus();
    return AppendFloats(absl::StrCat(field, ".data"), *data.json, 1, &raw);
  }

  absl::Status TakeBytes(const std::string& field, const Json& json, std::string* raw) {
    uint64_t size = 0;
    RETURN_IF_ERROR(ReadJson(field, json, &size));
    if (size > bytes_.size()) {
      return InvalidArgument(
          field,
          absl::StrCat("at most ", bytes_.size(), ", the bytes that are left behind the JSON"),
          size);
    }
    raw->assign(bytes_.data(), size);
    bytes_.remove_prefix(size);
    return absl::OkStatus();
  }

  absl::Status ReadOutput(const std::string& field, const Json& json) {
    auto& output = *request_.message.add_outputs();
    std::map<std::string, Member> parameters;
    JsonObject object(field, json);
    object.Required("name", output.mutable_name());
    object.Optional("parameters", &parameters);
    RETURN_IF_ERROR(object.Finish());
    Member binary;
    auto status = ReadParameters(absl::StrCat(field, ".parameters"), parameters, kBinaryOutput,
                                 &binary, output.mutable_parameters());
    if (!status.ok() || binary.json == nullptr) return status;
    bool wanted = false;
    status = ReadJson(absl::StrCat(field, ".parameters.", kBinaryOutput), *binary.json, &wanted);
    if (status.ok()) {
      (wanted ? request_.outputs.binary : request_.outputs.json).insert(output.name());
    }
    return status;
  }

  absl::string_view bytes_;
  HttpInferRequest request_;
};

template <typename T>
OrderedJson NumbersOf(const std::string& raw) {
  std::vector<T> values(raw.size() / sizeof(T));
  std::memcpy(values.data(), raw.data(), values.size() * sizeof(T));
  return values;
}

OrderedJson ToJson(const inference::InferParameter& parameter) {
  switch (parameter.parameter_choice_case()) {
    case inference::InferParameter::kBoolParam:
      return parameter.bool_param();
    case inference::InferParameter::kInt64Param:
      return parameter.int64_param();
    case inference::InferParameter::kUint64Param:
      return parameter.uint64_param();
    case inference::InferParameter::kDoubleParam:
      return parameter.double_param();
    default:
      return parameter.string_param();
  }
}

template <typename Tensors>
OrderedJson TensorsToJson(const Tensors& tensors) {
  OrderedJson list = OrderedJson::array();
  for (const auto& tensor : tensors) {
    list.push_back({{"name", tensor.name()},
                    {"datatype", tensor.datatype()},
                    {"shape", std::vector<int64_t>(tensor.shape().begin(), tensor.shape().end())}});
  }
  return list;
}

}  // namespace

bool BinaryOutputs::Wants(const std::string& name) const {
  return binary.contains(name) || (by_default && !json.contains(name));
}

absl::StatusOr<HttpInferRequest> ReadHttpInfer(absl::string_view body,
                                               std::optional<size_t> json_bytes) {
  const size_t length = json_bytes.value_or(body.size());
  if (length > body.size()) {
    return InvalidArgument("Inference-Header-Content-Length",
                           absl::StrCat("at most ", body.size(), ", the length of the body"),
                           length);
  }
  ASSIGN_OR_RETURN(const auto json, ParseJsonObject("body", body.substr(0, length)));
  return InferReader(body.substr(length)).Read(json);
}

HttpInferResponse WriteHttpInfer(const inference::ModelInferResponse& message,
                                 const BinaryOutputs& outputs) {
  SPIKESERVE_DCHECK_EQ(message.raw_output_contents_size(), message.outputs_size());
  OrderedJson json = {{"model_name", message.model_name()},
                      {"model_version", message.model_version()}};
  if (!message.id().empty()) json["id"] = message.id();
  for (const auto& [name, parameter] : message.parameters()) {
    json["parameters"][name] = ToJson(parameter);
  }
  json["outputs"] = TensorsToJson(message.outputs());
  std::string bytes;
  const int count = std::min(message.outputs_size(), message.raw_output_contents_size());
  for (int i = 0; i < count; ++i) {
    const std::string& raw = message.raw_output_contents(i);
    OrderedJson& output = json["outputs"][static_cast<size_t>(i)];
    if (outputs.Wants(message.outputs(i).name())) {
      output["parameters"] = {{kBinarySize, raw.size()}};
      bytes += raw;
    } else if (message.outputs(i).datatype() == "INT64") {
      output["data"] = NumbersOf<int64_t>(raw);
    } else {
      output["data"] = NumbersOf<float>(raw);
    }
  }
  HttpInferResponse response = {.body = JsonText(json), .json_bytes = std::nullopt};
  if (!bytes.empty()) response.json_bytes = response.body.size();
  response.body += bytes;
  return response;
}

std::string ToHttpBody(const google::protobuf::Message& message) {
  return JsonText(MessageToFields(message, Numbers::kExact));
}

std::string HttpErrorBody(absl::string_view message) {
  return JsonText({{"error", std::string(message)}});
}

}  // namespace spikeserve
