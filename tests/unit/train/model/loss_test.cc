#include "train/model/loss.h"

#include <gtest/gtest.h>

#include <cmath>

namespace spikeserve {
namespace {

Population Firing(Stage stage, double rate, int64_t tokens) {
  return {stage, 0, torch::full({5, 1, tokens, 8}, rate).requires_grad_(), {}};
}

TEST(RateHingeTest, PushesOnlyPopulationsAboveTheirTarget) {
  const std::vector<Population> populations = {Firing(Stage::kQuery, 0.05, 6),
                                               Firing(Stage::kKey, 0.30, 6),
                                               Firing(Stage::kReadout, 0.30, 2)};
  const torch::Tensor hinge =
      RateHinge(populations, {.hidden = 0.10, .readout = 0.25}, torch::ones({1, 2}));
  EXPECT_NEAR(hinge.item<double>(), 0.20 + 0.05, 1e-6);
  hinge.backward();
  EXPECT_FALSE(populations[0].spikes.grad().defined());
  EXPECT_NEAR(populations[1].spikes.grad().sum().item<double>(), 1.0, 1e-5);
  EXPECT_NEAR(populations[2].spikes.grad().sum().item<double>(), 1.0, 1e-5);
}

TEST(RateHingeTest, LeavesPaddingOut) {
  Population population = Firing(Stage::kKey, 0.0, 6);
  population.spikes = torch::zeros({5, 1, 6, 8});
  population.spikes.slice(2, 3, 6).fill_(1.0);  // the three tokens of the second timestep
  const RateTargets targets = {.hidden = 0.1, .readout = 0.1};
  const torch::Tensor first = torch::tensor({1.0f, 0.0f}).unsqueeze(0);
  EXPECT_FALSE(RateHinge({population}, targets, first).defined());
  EXPECT_NEAR(RateHinge({population}, targets, 1.0 - first).item<double>(), 0.9, 1e-6);
}

TEST(RateHingeTest, LeavesPhaseSpikesAlone) {
  EXPECT_FALSE(RateHinge({Firing(Stage::kPhase, 0.5, 2)}, {.hidden = 0.0, .readout = 0.0},
                         torch::ones({1, 2}))
                   .defined());
}

TEST(OperationShareTest, WeighsASpikeByTheSynapsesThatItMeets) {
  const ModelConfig config = {.hidden_size = 8, .context = 4, .ffn_size = 32};
  const torch::Tensor mask = torch::ones({1, 2});
  // All populations have 8 neurons. A coder's spike meets 24 synapses, an FFN coder's 32, a query's
  // 12; the readout and the phase generators do not count.
  const std::vector<Population> populations = {
      Firing(Stage::kCoder, 0.5, 6), Firing(Stage::kFfnIn, 0.1, 6), Firing(Stage::kQuery, 0.2, 6),
      Firing(Stage::kPhase, 0.9, 2), Firing(Stage::kReadout, 0.9, 2)};
  const torch::Tensor share = OperationShare(populations, config, mask);
  EXPECT_NEAR(share.item<double>(), (24 * 0.5 + 32 * 0.1 + 12 * 0.2) / (24 + 32 + 12), 1e-6);
  share.backward();
  EXPECT_NEAR(populations[0].spikes.grad().sum().item<double>(), 24.0 / 68.0, 1e-5);
  EXPECT_FALSE(populations[3].spikes.grad().defined());
  EXPECT_FALSE(OperationShare({}, config, mask).defined()) << "mode dense";
}

TEST(ImitationLossTest, IsTheMaskedCrossEntropyForDiscreteActions) {
  const torch::Tensor logits = torch::tensor({{{0.0f, 0.0f}, {9.0f, -9.0f}}});
  const torch::Tensor targets = torch::tensor({{{0.0f, 1.0f}, {0.0f, 1.0f}}});
  const ActionSpace space = ActionSpace::Discrete(2);
  EXPECT_NEAR(ImitationLoss(space, logits, targets, torch::tensor({{1.0f, 0.0f}}), torch::ones({2}))
                  .item<double>(),
              std::log(2.0), 1e-6);
  EXPECT_NEAR(ImitationLoss(space, logits, targets, torch::tensor({{1.0f, 1.0f}}), torch::ones({2}))
                  .item<double>(),
              (std::log(2.0) + 18.0) / 2.0, 1e-5);
}

TEST(ImitationLossTest, IsTheSquaredDistanceOfTanhForBoxesInUnitsOfTheSpread) {
  const torch::Tensor logits = torch::tensor({{{0.5f}}}), targets = torch::tensor({{{-1.0f}}});
  const ActionSpace space = ActionSpace::Box({-2.0f}, {2.0f});
  const auto loss = [&](float spread) {
    return ImitationLoss(space, logits, targets, torch::ones({1, 1}), torch::tensor({spread}))
        .item<double>();
  };
  EXPECT_NEAR(loss(1.0f), std::pow(std::tanh(0.5) + 1.0, 2.0), 1e-5);
  EXPECT_NEAR(loss(0.5f), 4.0 * std::pow(std::tanh(0.5) + 1.0, 2.0), 1e-5);
}

}  // namespace
}  // namespace spikeserve
