#include "core/model/config.h"

#include <gtest/gtest.h>

#include <limits>
#include <string>
#include <vector>

namespace spikeserve {
namespace {

TEST(ConfigNames, RoundTrip) {
  for (const char* name : {"baseline", "pos", "route", "full", "dense"}) {
    ASSERT_TRUE(ParseEnum<Mode>("mode", name).ok()) << name;
    EXPECT_EQ(ToString(*ParseEnum<Mode>("mode", name)), name);
  }
  for (const char* name : {"timestep", "window"}) {
    EXPECT_EQ(ToString(*ParseEnum<PhaseClock>("phase_clock", name)), name);
  }
  for (const char* name : {"sum", "concat"})
    EXPECT_EQ(ToString(*ParseEnum<Merge>("merge", name)), name);
  for (const char* name : {"softmax", "sigmoid"})
    EXPECT_EQ(ToString(*ParseEnum<Gate>("gate", name)), name);
  for (const char* name : {"layer", "none"})
    EXPECT_EQ(ToString(*ParseEnum<NormKind>("norm", name)), name);
  for (const char* name : {"float32", "integer"})
    EXPECT_EQ(ToString(*ParseEnum<Arithmetic>("arithmetic", name)), name);
}

TEST(ConfigNames, UnknownNamesAreRefusedWithTheKnownOnes) {
  EXPECT_EQ(ParseEnum<Mode>("mode", "Full").status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(ParseEnum<Gate>("gate", "relu").status().message(),
            "gate: expected softmax or sigmoid, received \"relu\"");
}

TEST(ModelConfig, DefaultsAreThePapersAndValid) {
  const ModelConfig config;
  EXPECT_TRUE(config.Validate().ok());
  EXPECT_EQ(config.head_size(), 32);
  EXPECT_EQ(config.attention_inputs(), 132);
  EXPECT_EQ(config.merged_size(), 32);
}

TEST(ModelConfig, SizesFollowTheMode) {
  EXPECT_EQ(ModelConfig{.mode = Mode::kRoute}.attention_inputs(), 128);
  EXPECT_EQ(ModelConfig{.mode = Mode::kPos}.attention_inputs(), 132);
  EXPECT_EQ(ModelConfig{.merge = Merge::kConcat}.merged_size(), 128);
  EXPECT_EQ(ModelConfig{.mode = Mode::kDense}.merged_size(), 128);
}

TEST(ModelConfig, ValidateNamesTheField) {
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const float infinity = std::numeric_limits<float>::infinity();
  const struct {
    ModelConfig config;
    std::string message;
  } cases[] = {
      {{.hidden_size = 0}, "hidden_size: expected 1 to 4096, received 0"},
      {{.hidden_size = 8192}, "hidden_size: expected 1 to 4096, received 8192"},
      {{.hidden_size = 130}, "hidden_size: expected a multiple of heads = 4, received 130"},
      {{.heads = -1}, "heads: expected 1 to 64, received -1"},
      {{.heads = 128}, "heads: expected 1 to 64, received 128"},
      {{.layers = 65}, "layers: expected 1 to 64, received 65"},
      {{.ticks = 0}, "ticks: expected 1 to 256, received 0"},
      {{.context = 0}, "context: expected 1 to 4096, received 0"},
      {{.routing_hidden_size = 0}, "routing_hidden_size: expected 1 to 4096, received 0"},
      {{.ffn_size = 16385}, "ffn_size: expected 1 to 16384, received 16385"},
      {{.membrane_decay = -0.5f}, "membrane_decay: expected 0 to 1, received -0.5"},
      {{.membrane_decay = 1.5f}, "membrane_decay: expected 0 to 1, received 1.5"},
      {{.membrane_decay = nan}, "membrane_decay: expected 0 to 1, received nan"},
      {{.threshold = 0.0f}, "threshold: expected a positive finite number, received 0"},
      {{.threshold = infinity}, "threshold: expected a positive finite number, received inf"},
      {{.mode = Mode::kDense, .norm = NormKind::kNone},
       "norm: expected layer in mode dense, received none"},
      {{.ticks = 256, .membrane_decay = 0.9375f, .arithmetic = Arithmetic::kInteger},
       "ticks: expected 1 to 255, received 256"},
      {{.mode = Mode::kDense, .relative_bias = true},
       "relative_bias: expected false in mode dense, received true"},
  };
  for (const auto& c : cases) {
    const absl::Status status = c.config.Validate();
    EXPECT_EQ(status.code(), absl::StatusCode::kInvalidArgument) << c.message;
    EXPECT_EQ(status.message(), c.message);
  }
}

}  // namespace
}  // namespace spikeserve
