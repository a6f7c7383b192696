#include "server/inference/inference_tensors.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "tests/support/small_config.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

using inference::ModelInferRequest;
using inference::ModelInferResponse;

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

// Returns an answer with a discrete action.
v1::ActResponse MakeAnswer() {
  v1::ActResponse answer;
  answer.mutable_action()->set_discrete(1);
  answer.add_action_probabilities(0.25f);
  answer.add_action_probabilities(0.75f);
  answer.set_return_to_go(499.0);
  answer.mutable_stats()->set_spikes(321);
  return answer;
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

TEST(InferenceTensorsTest, ABatchOfOneIsTaken) {
  const auto input = ReadInputs(Typed({1, 2}, {1.0f, 2.0f}));
  ASSERT_TRUE(input.ok()) << input.status();
  EXPECT_THAT(input->observation, ElementsAre(1.0f, 2.0f));
  EXPECT_TRUE(input->batched);
  EXPECT_EQ(input->reward, std::nullopt);
}

TEST(InferenceTensorsTest, WrongInputsAreNamed) {
  EXPECT_THAT(Refusal(ModelInferRequest()), HasSubstr("observation, received none"));
  EXPECT_THAT(Refusal(Typed({3}, {1.0f, 2.0f})),
              HasSubstr("expected what its shape [3] holds, received 2 fp32_contents"));
  EXPECT_THAT(Refusal(Typed({2, 1}, {1.0f, 2.0f})),
              HasSubstr("expected shape [n] or [1, n], received [2, 1]"));
  EXPECT_THAT(Refusal(Typed({}, {1.0f})), HasSubstr("received []"));
  EXPECT_THAT(Refusal(Typed({-1}, {})), HasSubstr("received 0 fp32_contents"));

  ModelInferRequest wrong_type = Typed({1}, {1.0f});
  wrong_type.mutable_inputs(0)->set_datatype("FP64");
  EXPECT_THAT(Refusal(wrong_type), HasSubstr("expected datatype FP32, received \"FP64\""));

  ModelInferRequest unknown = Typed({1}, {1.0f});
  AddInput("image", {1}, &unknown);
  EXPECT_THAT(Refusal(unknown), HasSubstr("input \"image\": expected observation or reward"));

  ModelInferRequest twice = Typed({1}, {1.0f});
  *twice.add_inputs() = twice.inputs(0);
  EXPECT_THAT(Refusal(twice), HasSubstr("expected one of this name, received two"));

  ModelInferRequest two_rewards = Typed({1}, {1.0f});
  auto* reward = AddInput("reward", {2}, &two_rewards)->mutable_contents();
  reward->add_fp32_contents(1.0f);
  reward->add_fp32_contents(1.0f);
  EXPECT_THAT(Refusal(two_rewards), HasSubstr("expected shape [1] or [1, 1], received [2]"));
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

TEST(InferenceTensorsTest, AnswersComeAsTheInputsCame) {
  const InferenceInput typed = {
      .observation = {}, .reward = std::nullopt, .batched = false, .raw = false};
  ModelInferResponse response;
  WriteOutputs(MakeAnswer(), ModelInferRequest(), typed, &response);
  ASSERT_EQ(response.outputs_size(), 4);
  EXPECT_EQ(response.outputs(0).name(), "action");
  EXPECT_EQ(response.outputs(0).datatype(), "INT64");
  EXPECT_THAT(response.outputs(0).contents().int64_contents(), ElementsAre(1));
  EXPECT_THAT(response.outputs(1).contents().fp32_contents(), ElementsAre(0.25f, 0.75f));
  EXPECT_THAT(response.outputs(1).shape(), ElementsAre(2));
  EXPECT_THAT(response.outputs(2).contents().fp32_contents(), ElementsAre(499.0f));
  EXPECT_THAT(response.outputs(3).contents().int64_contents(), ElementsAre(321));
  EXPECT_EQ(response.raw_output_contents_size(), 0);

  InferenceInput raw = typed;
  raw.raw = raw.batched = true;
  response.Clear();
  WriteOutputs(MakeAnswer(), ModelInferRequest(), raw, &response);
  ASSERT_EQ(response.raw_output_contents_size(), 4);
  EXPECT_EQ(response.raw_output_contents(0), std::string("\1\0\0\0\0\0\0\0", 8));
  EXPECT_THAT(response.outputs(1).shape(), ElementsAre(1, 2));
  EXPECT_FALSE(response.outputs(1).has_contents());
}

TEST(InferenceTensorsTest, OutputsAreThoseOfTheActionSpace) {
  const Policy box = RandomPolicy(SmallConfig(), 3, ActionSpace::Box({-2.0f}, {2.0f}), /*seed=*/1);
  ModelInferRequest request;
  request.add_outputs()->set_name("probabilities");
  const auto status = CheckOutputs(request, OutputSpecs(box));
  EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(status.message()), HasSubstr("[action, return_to_go, spikes]"));

  request.mutable_outputs(0)->set_name("action");
  EXPECT_TRUE(CheckOutputs(request, OutputSpecs(box)).ok());
  v1::ActResponse answer;
  answer.mutable_action()->mutable_continuous()->add_values(-0.5f);
  ModelInferResponse response;
  WriteOutputs(answer, request, InferenceInput(), &response);
  ASSERT_EQ(response.outputs_size(), 1);
  EXPECT_THAT(response.outputs(0).contents().fp32_contents(), ElementsAre(-0.5f));
}

}  // namespace
}  // namespace spikeserve
