#include "server/inference/inference_sequence.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

inference::ModelInferRequest MakeRequest() {
  inference::ModelInferRequest request;
  request.set_model_name("cartpole");
  return request;
}

std::string SequenceRefusal(const inference::ModelInferRequest& request) {
  const auto sequence = ReadSequence(request);
  EXPECT_EQ(sequence.status().code(), absl::StatusCode::kInvalidArgument);
  return std::string(sequence.status().message());
}

TEST(InferenceSequenceTest, IntegersAndStringsAreDifferentIds) {
  auto request = MakeRequest();
  auto& parameters = *request.mutable_parameters();
  parameters["sequence_id"].set_int64_param(7);
  parameters["sequence_start"].set_bool_param(true);
  auto sequence = ReadSequence(request);
  ASSERT_TRUE(sequence.ok()) << sequence.status();
  EXPECT_EQ(sequence->session_id, "sequence:cartpole:7");
  EXPECT_TRUE(sequence->start);
  EXPECT_FALSE(sequence->end);

  parameters["sequence_id"].set_string_param("7");
  parameters["sequence_end"].set_bool_param(true);
  sequence = ReadSequence(request);
  ASSERT_TRUE(sequence.ok()) << sequence.status();
  EXPECT_EQ(sequence->session_id, "sequence:cartpole:\"7\"");
  EXPECT_TRUE(sequence->end);
}

TEST(InferenceSequenceTest, NoIdIsRefusedWithWhatToSend) {
  auto request = MakeRequest();
  EXPECT_THAT(SequenceRefusal(request), HasSubstr("send sequence_id"));
  (*request.mutable_parameters())["sequence_id"].set_int64_param(0);
  EXPECT_THAT(SequenceRefusal(request), HasSubstr("send sequence_id"));
  (*request.mutable_parameters())["sequence_id"].set_string_param("");
  EXPECT_THAT(SequenceRefusal(request), HasSubstr("send sequence_id"));
}

TEST(InferenceSequenceTest, WrongParametersAreNamed) {
  auto request = MakeRequest();
  auto& parameters = *request.mutable_parameters();
  parameters["sequence_id"].set_bool_param(true);
  EXPECT_THAT(SequenceRefusal(request), HasSubstr("expected an int64_param or a string_param"));
  parameters["sequence_id"].set_string_param(std::string(257, 'x'));
  EXPECT_THAT(SequenceRefusal(request), HasSubstr("at most 256 bytes"));
  parameters["sequence_id"].set_string_param("seven");
  parameters["sequence_start"].set_int64_param(1);
  EXPECT_THAT(SequenceRefusal(request),
              HasSubstr("parameters.sequence_start: expected a bool_param"));
}

TEST(InferenceSequenceTest, AStartMayNameVersionTargetReturnAndSeed) {
  auto request = MakeRequest();
  auto opening = ReadOpening(request);
  ASSERT_TRUE(opening.ok()) << opening.status();
  EXPECT_EQ(opening->policy(), "cartpole");
  EXPECT_EQ(opening->version(), 0);
  EXPECT_FALSE(opening->has_target_return());

  request.set_model_version("3");
  (*request.mutable_parameters())["target_return"].set_int64_param(200);
  (*request.mutable_parameters())["seed"].set_int64_param(5);
  opening = ReadOpening(request);
  ASSERT_TRUE(opening.ok()) << opening.status();
  EXPECT_EQ(opening->version(), 3);
  EXPECT_EQ(opening->target_return(), 200.0);
  EXPECT_EQ(opening->seed(), 5u);
  EXPECT_FALSE(opening->record());

  (*request.mutable_parameters())["record"].set_bool_param(true);
  EXPECT_TRUE(ReadOpening(request)->record());
  (*request.mutable_parameters())["record"].set_int64_param(1);
  EXPECT_THAT(std::string(ReadOpening(request).status().message()),
              HasSubstr("parameters.record: expected a bool_param"));

  (*request.mutable_parameters())["seed"].set_double_param(0.5);
  EXPECT_THAT(std::string(ReadOpening(request).status().message()), HasSubstr("parameters.seed"));
}

TEST(InferenceSequenceTest, VersionsArePositiveIntegers) {
  for (const std::string version : {"0", "-1", "one", "1.0"}) {
    EXPECT_EQ(ReadVersion(version).status().code(), absl::StatusCode::kInvalidArgument) << version;
  }
}

}  // namespace
}  // namespace spikeserve
