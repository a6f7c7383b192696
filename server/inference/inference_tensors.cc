#include "server/inference/inference_tensors.h"

#include <bit>
#include <cstring>
#include <utility>

#include "absl/algorithm/container.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/types/span.h"
#include "core/base/json.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

// Raw contents are little-endian and are copied without conversion.
static_assert(std::endian::native == std::endian::little);

using inference::ModelInferRequest;
using inference::ModelInferResponse;
using InputTensor = ModelInferRequest::InferInputTensor;

absl::Status BadInput(const InputTensor& tensor, absl::string_view what) {
  return absl::InvalidArgumentError(absl::StrCat("input ", Quoted(tensor.name()), ": ", what));
}

std::string ShapeToString(const InputTensor& tensor) {
  return absl::StrCat("[", absl::StrJoin(tensor.shape(), ", "), "]");
}

// Returns the elements of an FP32 tensor of shape [n] or [1, n]. `raw` holds them as bytes; if it
// is null, they are in the contents of the tensor.
absl::StatusOr<std::vector<float>> ReadFloats(const InputTensor& tensor, const std::string* raw) {
  if (tensor.datatype() != "FP32") {
    return BadInput(tensor,
                    absl::StrCat("expected datatype FP32, received ", Quoted(tensor.datatype())));
  }
  if (tensor.parameters().contains("shared_memory_region")) {
    return BadInput(tensor, "expected contents, received a shared memory region");
  }
  const int rank = tensor.shape_size();
  if (rank < 1 || rank > 2 || (rank == 2 && tensor.shape(0) != 1)) {
    return BadInput(tensor,
                    absl::StrCat("expected shape [n] or [1, n], received ", ShapeToString(tensor)));
  }
  const int64_t size = tensor.shape(rank - 1);
  const auto& typed = tensor.contents().fp32_contents();
  const int64_t received =
      raw == nullptr ? typed.size() : static_cast<int64_t>(raw->size() / sizeof(float));
  if (received != size || (raw != nullptr && raw->size() % sizeof(float) != 0)) {
    return BadInput(
        tensor, absl::StrCat("expected what its shape ", ShapeToString(tensor), " holds, received ",
                             raw == nullptr ? typed.size() : raw->size(),
                             raw == nullptr ? " fp32_contents" : " bytes of FP32"));
  }
  if (raw == nullptr) return std::vector<float>(typed.begin(), typed.end());
  std::vector<float> values(static_cast<size_t>(size));
  std::memcpy(values.data(), raw->data(), raw->size());
  return values;
}

// Checks that the request has either raw contents, one for each input, or typed contents.
absl::Status CheckContents(const ModelInferRequest& request) {
  const int raw = request.raw_input_contents_size();
  if (raw == 0) return absl::OkStatus();
  if (raw != request.inputs_size()) {
    return InvalidArgument("raw_input_contents",
                           absl::StrCat("one an input, ", request.inputs_size()), raw);
  }
  for (const InputTensor& tensor : request.inputs()) {
    if (tensor.has_contents()) {
      return BadInput(tensor, "expected no contents beside raw_input_contents, received some");
    }
  }
  return absl::OkStatus();
}

// Adds to the response the output tensors that the request names. Uses raw bytes and a batch
// dimension if the inputs did.
class OutputWriter {
 public:
  OutputWriter(const ModelInferRequest& request, const InferenceInput& input,
               ModelInferResponse* response)
      : request_(request), input_(input), response_(response) {}

  void Add(const char* name, absl::Span<const float> values) {
    AddTensor(name, inference::TYPE_FP32, values, [](inference::InferTensorContents* contents) {
      return contents->mutable_fp32_contents();
    });
  }

  void Add(const char* name, int64_t value) {
    AddTensor(name, inference::TYPE_INT64, absl::MakeConstSpan(&value, 1),
              [](inference::InferTensorContents* contents) {
                return contents->mutable_int64_contents();
              });
  }

 private:
  template <typename T, typename Field>
  void AddTensor(const char* name, inference::DataType type, absl::Span<const T> values,
                 Field field) {
    if (!IsWanted(name)) return;
    auto* tensor = response_->add_outputs();
    tensor->set_name(name);
    tensor->set_datatype(DataTypeName(type));
    if (input_.batched) tensor->add_shape(1);
    tensor->add_shape(static_cast<int64_t>(values.size()));
    if (input_.raw) {
      response_->add_raw_output_contents(values.data(), values.size() * sizeof(T));
    } else {
      field(tensor->mutable_contents())->Add(values.begin(), values.end());
    }
  }

  bool IsWanted(absl::string_view name) const {
    return request_.outputs().empty() ||
           absl::c_any_of(request_.outputs(),
                          [&](const auto& output) { return output.name() == name; });
  }

  const ModelInferRequest& request_;
  const InferenceInput& input_;
  ModelInferResponse* const response_;
};

}  // namespace

std::vector<TensorSpec> InputSpecs(const Policy& policy) {
  return {{.name = "observation",
           .data_type = inference::TYPE_FP32,
           .shape = {policy.observation_size()}},
          {.name = "reward", .data_type = inference::TYPE_FP32, .shape = {1}, .optional = true}};
}

std::vector<TensorSpec> OutputSpecs(const Policy& policy) {
  const ActionSpace& space = policy.action_space;
  std::vector<TensorSpec> specs;
  if (space.is_discrete()) {
    specs.push_back({.name = "action", .data_type = inference::TYPE_INT64, .shape = {1}});
    specs.push_back(
        {.name = "probabilities", .data_type = inference::TYPE_FP32, .shape = {space.n}});
  } else {
    specs.push_back({.name = "action", .data_type = inference::TYPE_FP32, .shape = {space.size()}});
  }
  specs.push_back({.name = "return_to_go", .data_type = inference::TYPE_FP32, .shape = {1}});
  specs.push_back({.name = "spikes", .data_type = inference::TYPE_INT64, .shape = {1}});
  return specs;
}

std::string DataTypeName(inference::DataType type) {
  return type == inference::TYPE_INT64 ? "INT64" : "FP32";
}

absl::StatusOr<InferenceInput> ReadInputs(const ModelInferRequest& request) {
  RETURN_IF_ERROR(CheckContents(request));
  InferenceInput input;
  input.raw = request.raw_input_contents_size() > 0;
  bool has_observation = false;
  for (int i = 0; i < request.inputs_size(); ++i) {
    const InputTensor& tensor = request.inputs(i);
    const bool is_observation = tensor.name() == "observation";
    if (!is_observation && tensor.name() != "reward") {
      return BadInput(tensor, "expected observation or reward");
    }
    if (is_observation ? has_observation : input.reward.has_value()) {
      return BadInput(tensor, "expected one of this name, received two");
    }
    ASSIGN_OR_RETURN(auto values,
                     ReadFloats(tensor, input.raw ? &request.raw_input_contents(i) : nullptr));
    if (is_observation) {
      has_observation = true;
      input.observation = std::move(values);
      input.batched = tensor.shape_size() == 2;
    } else if (values.size() == 1) {
      input.reward = values.front();
    } else {
      return BadInput(
          tensor, absl::StrCat("expected shape [1] or [1, 1], received ", ShapeToString(tensor)));
    }
  }
  if (has_observation) return input;
  return InvalidArgument("inputs", "one of the name observation", "none");
}

absl::Status CheckOutputs(const ModelInferRequest& request, const std::vector<TensorSpec>& specs) {
  for (const auto& output : request.outputs()) {
    if (output.parameters().contains("shared_memory_region")) {
      return InvalidArgument(absl::StrCat("output ", Quoted(output.name())), "contents",
                             "a shared memory region");
    }
    if (absl::c_any_of(specs, [&](const TensorSpec& spec) { return spec.name == output.name(); })) {
      continue;
    }
    const std::string names = absl::StrJoin(
        specs, ", ", [](std::string* out, const TensorSpec& spec) { *out += spec.name; });
    return InvalidArgument("outputs", absl::StrCat("any of [", names, "]"), Quoted(output.name()));
  }
  return absl::OkStatus();
}

void WriteOutputs(const v1::ActResponse& answer, const ModelInferRequest& request,
                  const InferenceInput& input, ModelInferResponse* response) {
  OutputWriter writer(request, input, response);
  const v1::Action& action = answer.action();
  if (action.has_discrete()) {
    writer.Add("action", action.discrete());
    writer.Add("probabilities", answer.action_probabilities());
  } else {
    writer.Add("action", action.continuous().values());
  }
  const auto return_to_go = static_cast<float>(answer.return_to_go());  // exact: widened from float
  writer.Add("return_to_go", absl::MakeConstSpan(&return_to_go, 1));
  writer.Add("spikes", static_cast<int64_t>(answer.stats().spikes()));
}

}  // namespace spikeserve
