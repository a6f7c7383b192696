#include "server/inference/inference_tensors.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

using inference::ModelInferRequest;

ModelInferRequest::InferInputTensor* AddInput(const std::string& name,
                                              const std::vector<int64_t>& shape,
                                              ModelInferRequest* request) {
  auto* tensor = request->add_inputs();
  tensor->set_name(name);
  tensor->set_datatype("FP32");
  for (const int64_t size : shape) tensor->add_shape(size);
  return tensor;
}

ModelInferRequest Typed(const std::vector<int64_t>& shape, const std::vector<float>& observation) {
  ModelInferRequest request;
  auto* contents = AddInput("observation", shape, &request)->mutable_contents();
  contents->mutable_fp32_contents()->Add(observation.begin(), observation.end());
  return request;
}

void AddRaw(const std::string& name, const std::vector<float>& values, ModelInferRequest* request) {
  AddInput(name, {static_cast<int64_t>(values.size())}, request);
  request->add_raw_input_contents(values.data(), values.size() * sizeof(float));
}

std::string Refusal(const ModelInferRequest& request) {
  const auto input = ReadInputs(request);
  EXPECT_EQ(input.status().code(), absl::StatusCode::kInvalidArgument);
  return std::string(input.status().message());
}

TEST(InferenceTensorsTest, TypedAndRawContentsAreTheSameInput) {
  ModelInferRequest raw;
  AddRaw("reward", {0.5f}, &raw);
  AddRaw("observation", {1.0f, 2.0f, 3.0f}, &raw);
  ModelInferRequest typed = Typed({3}, {1.0f, 2.0f, 3.0f});
  AddInput("reward", {1}, &typed)->mutable_contents()->add_fp32_contents(0.5f);
  for (const auto& request : {raw, typed}) {
    const auto input = ReadInputs(request);
    ASSERT_TRUE(input.ok()) << input.status();
    EXPECT_THAT(input->observation, ElementsAre(1.0f, 2.0f, 3.0f));
    EXPECT_EQ(input->reward, 0.5f);
    EXPECT_FALSE(input->batched);
    EXPECT_EQ(input->raw, request.raw_input_contents_size() > 0);
  }
}

TEST(InferenceTensorsTest, RawContentsExcludeTyped) {
  ModelInferRequest both = Typed({1}, {1.0f});
  both.add_raw_input_contents("1234");
  EXPECT_THAT(Refusal(both), HasSubstr("expected no contents beside raw_input_contents"));

  ModelInferRequest too_few = Typed({1}, {1.0f});
  AddRaw("reward", {1.0f}, &too_few);
  EXPECT_THAT(Refusal(too_few), HasSubstr("expected one an input, 2, received 1"));

  ModelInferRequest cut;
  AddRaw("observation", {1.0f, 2.0f}, &cut);
  cut.mutable_raw_input_contents(0)->pop_back();
  EXPECT_THAT(Refusal(cut), HasSubstr("received 7 bytes of FP32"));
}

}  // namespace
}  // namespace spikeserve
