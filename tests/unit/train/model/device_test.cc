// Tests that a model computes on its device alone. No test machine has a GPU: tensors on torch's
// device `meta` have shapes and no values, and no operator accepts them beside tensors in memory.

#include "train/trainer/device.h"

#include <gtest/gtest.h>
#include <torch/library.h>
#include <torch/types.h>
#include <torch/version.h>

#include <array>
#include <string>
#include <tuple>
#include <vector>

#include "tests/support/small_policy.h"
#include "train/model/loss.h"
#include "train/model/torch_model.h"
#include "train/trainer/head_plasticity.h"

namespace spikeserve {
namespace {

using torch::Tensor;
#if TORCH_VERSION_MAJOR < 2  // has not all operators on `meta`
using OptionalTensor = c10::optional<Tensor>;

Tensor ReluOnMeta(const Tensor& x) { return torch::empty_like(x); }
Tensor& AbsOnMeta(const Tensor& x, Tensor& out) {
  out.resize_(x.sizes());
  return out;
}

std::tuple<Tensor, Tensor, Tensor> LayerNormOnMeta(const Tensor& x, c10::SymIntArrayRef,
                                                   const OptionalTensor& weight,
                                                   const OptionalTensor& bias, double) {
  EXPECT_TRUE(x.is_meta() && weight->is_meta() && bias->is_meta());
  const Tensor moment = torch::empty_like(x.select(-1, 0));
  return {torch::empty_like(x), moment, moment.clone()};
}

std::tuple<Tensor, Tensor, Tensor> LayerNormBackwardOnMeta(
    const Tensor& gradient, const Tensor& x, c10::SymIntArrayRef, const Tensor&, const Tensor&,
    const OptionalTensor& weight, const OptionalTensor& bias, std::array<bool, 3>) {
  EXPECT_TRUE(gradient.is_meta());
  return {torch::empty_like(x), torch::empty_like(*weight), torch::empty_like(*bias)};
}

Tensor IndexSelectOnMeta(const Tensor& x, int64_t dimension, const Tensor& index) {
  EXPECT_TRUE(x.is_meta() && index.is_meta());
  std::vector<int64_t> shape = x.sizes().vec();
  shape[dimension] = index.size(0);
  return torch::empty(shape, x.options());
}

TORCH_LIBRARY_IMPL(aten, Meta, library) {
  library.impl("relu", ReluOnMeta);
  library.impl("abs.out", AbsOnMeta);
  library.impl("index_select", IndexSelectOnMeta);
  library.impl("native_layer_norm", LayerNormOnMeta);
  library.impl("native_layer_norm_backward", LayerNormBackwardOnMeta);
}
#endif

constexpr int64_t kClips = 2, kSteps = 5;

ClipTensors MetaClips(const Policy& policy) {
  const auto options = torch::TensorOptions(torch::kMeta).dtype(torch::kFloat);
  const auto numbers = options.dtype(torch::kLong);
  return {.return_to_go = torch::empty({kClips, kSteps}, options),
          .observations = torch::empty({kClips, kSteps, policy.observation_size()}, options),
          .actions = torch::empty({kClips, kSteps, policy.action_space.size()}, options),
          .timesteps = torch::empty({kClips, kSteps}, numbers),
          .previous = torch::empty({kClips, policy.observation_size()}, options)};
}

class ModelDeviceTest : public testing::TestWithParam<Mode> {};

TEST_P(ModelDeviceTest, ForwardAndBackwardStayOnTheDevice) {
  ModelConfig config = SmallConfig(GetParam());
  config.observation_changes = true;
  const Policy policy = SmallPolicy(config);
  const TorchModel model(policy, Surrogate{}, Arithmetic::kFloat32, {}, /*seed=*/0, torch::kMeta);
  const ModelOutput output = model.Forward(MetaClips(policy));
  EXPECT_TRUE(output.logits.is_meta());
  const torch::Tensor mask = torch::empty({kClips, kSteps}, output.logits.options());
  torch::Tensor loss = ImitationLoss(policy.action_space, output.logits,
                                     torch::empty_like(output.logits), mask, mask);
  if (const auto share = OperationShare(output.populations, config, mask); share.defined()) {
    loss = loss + share;
  }
  loss.backward();
  for (const auto& [name, tensor] : model.parameters().tensors()) {
    EXPECT_TRUE(tensor.is_meta()) << name;
    EXPECT_TRUE(!tensor.grad().defined() || tensor.grad().is_meta()) << name;
  }
  EXPECT_TRUE(model.parameters()["embed.state.weight"].grad().defined());
  EXPECT_TRUE(model.parameters()["head.weight"].grad().defined());
  const torch::Tensor change = HeadChange({.rate = 0.1}, policy.action_space, output,
                                          {.return_to_go = mask,
                                           .targets = torch::empty_like(output.logits),
                                           .mask = mask,
                                           .mean = 0.0,
                                           .deviation = 1.0});
  EXPECT_TRUE(change.is_meta());
}

INSTANTIATE_TEST_SUITE_P(Modes, ModelDeviceTest,
                         testing::Values(Mode::kBaseline, Mode::kPos, Mode::kRoute, Mode::kFull,
                                         Mode::kDense),
                         [](const auto& mode) { return std::string(ToString(mode.param)); });

TEST(DeviceTest, NamesAreThoseOfDevicesThatAreHere) {
  EXPECT_TRUE(DeviceNamed("cpu")->is_cpu());
  for (const char* name : {"", "gpu", "cuda:", "cuda:-1", "cuda:x", "cudax", "meta"}) {
    EXPECT_EQ(DeviceNamed(name).status().message(),
              std::string("--device: expected cpu, cuda or cuda:N, received ") + name);
  }
  EXPECT_EQ(DeviceNamed("cuda:99").status().code(), absl::StatusCode::kInvalidArgument);
}

TEST(DeviceTest, IntegersNeedTheProcessor) {
  EXPECT_TRUE(CheckDevice(torch::kCUDA, Arithmetic::kFloat32).ok());
  EXPECT_EQ(CheckDevice(torch::kCUDA, Arithmetic::kInteger).message(),
            "--device: expected cpu with --arithmetic=integer, received cuda");
  EXPECT_TRUE(CheckDevice(torch::kCPU, Arithmetic::kInteger).ok());
}

}  // namespace
}  // namespace spikeserve
