// Tests of an agent's calls, from listing the policies to the end of its episodes.
#include <cmath>

#include "tests/integration/server_fixture.h"

namespace spikeserve {
namespace {

class EpisodeTest : public ServerTest {};

TEST_F(EpisodeTest, PoliciesAreListed) {
  v1::ListPoliciesResponse list;
  ASSERT_TRUE(client_->stub().ListPolicies(NewContext().get(), {}, &list).ok());
  ASSERT_EQ(list.policies_size(), 3);
  EXPECT_EQ(list.policies(0).name(), "box");
  EXPECT_EQ(list.policies(0).action_space().box().low(0), -2.0f);
  EXPECT_EQ(list.policies(0).action_space().box().high(0), 2.0f);
  const v1::PolicyInfo& older = list.policies(1);
  const v1::PolicyInfo& newer = list.policies(2);
  EXPECT_EQ(older.version(), 1);
  EXPECT_FALSE(older.is_default());
  EXPECT_EQ(newer.name(), "discrete");
  EXPECT_EQ(newer.version(), 2);
  EXPECT_TRUE(newer.is_default());
  EXPECT_EQ(newer.observation_size(), kObservationSize);
  EXPECT_EQ(newer.action_space().discrete().n(), 2);
  EXPECT_EQ(newer.context_length(), 4);
  EXPECT_EQ(newer.target_return(), 25.0);
  EXPECT_EQ(newer.training_return(), 12.5);
  EXPECT_EQ(newer.environment(), "Test-v0");
  EXPECT_EQ(newer.mode(), "full");
}

TEST_F(EpisodeTest, ASessionIsPinnedToItsVersion) {
  v1::OpenSessionRequest request;
  request.set_policy("discrete");
  v1::OpenSessionResponse opened;
  ASSERT_TRUE(client_->stub().OpenSession(NewContext().get(), request, &opened).ok());
  EXPECT_EQ(opened.policy(), "discrete");
  EXPECT_EQ(opened.version(), 2);
  EXPECT_EQ(opened.observation_size(), kObservationSize);
  EXPECT_EQ(opened.action_space().discrete().n(), 2);
  EXPECT_EQ(opened.context_length(), 4);
  EXPECT_EQ(opened.target_return(), 25.0);
  request.set_version(1);
  request.set_target_return(-3.5);
  ASSERT_TRUE(client_->stub().OpenSession(NewContext().get(), request, &opened).ok());
  EXPECT_EQ(opened.version(), 1);
  EXPECT_EQ(opened.target_return(), -3.5);
}

TEST_F(EpisodeTest, AnswersCarryActionAndStatistics) {
  const v1::ActResponse discrete = client_->Act(client_->Open("discrete"), 0);
  EXPECT_EQ(discrete.return_to_go(), 25.0);
  ASSERT_EQ(discrete.action_probabilities_size(), 2);
  EXPECT_NEAR(discrete.action_probabilities(0) + discrete.action_probabilities(1), 1.0, 1e-6);
  EXPECT_EQ(discrete.action().kind_case(), v1::Action::kDiscrete);

  const v1::DecisionStats& stats = discrete.stats();
  const v1::SpikesByStage& stages = stats.spikes_by_stage();
  EXPECT_GT(stats.spikes(), 0u);
  EXPECT_EQ(stats.spikes(), stages.coder() + stages.phase() + stages.query() + stages.key() +
                                stages.value() + stages.ffn_in() + stages.ffn_hidden() +
                                stages.readout());
  EXPECT_EQ(stats.synaptic_operations(), stats.accumulates() + stats.multiply_accumulates());
  // Every priced count is in the answer, so that the default estimate can be checked from it.
  const uint64_t multiplies = stats.multiply_accumulates() + stats.membrane_updates() +
                              stats.coder_gains() + stats.gate_products();
  EXPECT_NEAR(stats.energy_joules(),
              1e-12 * (0.9 * static_cast<double>(stats.accumulates() + stats.attention_products()) +
                       4.6 * static_cast<double>(multiplies) +
                       14.7 * static_cast<double>(stats.layer_norm_elements()) +
                       9.2 * static_cast<double>(stats.softmax_terms())),
              1e-15);
  EXPECT_EQ(stats.horowitz_energy_joules(), stats.energy_joules());
  EXPECT_DOUBLE_EQ(stats.spike_energy_joules(), 5e-12 * static_cast<double>(stats.spikes()));
  EXPECT_GT(stats.membrane_updates(), 0u);
  EXPECT_FALSE(stats.has_int_energy_joules());
  EXPECT_GT(stats.compute_seconds(), 0.0);

  const v1::ActResponse box = client_->Act(client_->Open("box"), 0);
  ASSERT_EQ(box.action().continuous().values_size(), 1);
  EXPECT_LE(std::abs(box.action().continuous().values(0)), 2.0f);
  EXPECT_EQ(box.action_probabilities_size(), 0);
}

TEST_F(EpisodeTest, EpisodesFollowEachOther) {
  const std::string session = client_->Open();
  uint64_t spikes = 0;
  double energy = 0.0;
  for (int64_t step = 0; step < 3; ++step) {
    const v1::DecisionStats stats = client_->Act(session, step).stats();
    spikes += stats.spikes();
    energy += stats.energy_joules();
  }
  const v1::EndEpisodeResponse end = client_->EndEpisode(session, 4.0);
  EXPECT_DOUBLE_EQ(end.episode_return(), 0.1 + 0.2 + 4.0);
  EXPECT_EQ(end.steps(), 3);
  EXPECT_EQ(end.spikes(), spikes);
  EXPECT_DOUBLE_EQ(end.energy_joules(), energy);

  client_->Act(session, 0);
  v1::GetSessionRequest request;
  request.set_session_id(session);
  v1::GetSessionResponse view;
  ASSERT_TRUE(client_->stub().GetSession(NewContext().get(), request, &view).ok());
  EXPECT_EQ(view.episode(), 1);
  EXPECT_EQ(view.step(), 1);
  EXPECT_EQ(view.episode_return(), 0.0);
  EXPECT_EQ(view.target_return(), 25.0);
  EXPECT_GT(view.spikes(), spikes);
  EXPECT_EQ(view.decisions(), 4u);
}

TEST_F(EpisodeTest, EqualSeedsSampleEqualActions) {
  const auto play = [&](uint64_t seed) {
    v1::OpenSessionRequest request;
    request.set_policy("box");
    request.set_action_selection(v1::SAMPLE);
    request.set_temperature(0.5);
    request.set_seed(seed);
    v1::OpenSessionResponse opened;
    EXPECT_TRUE(client_->stub().OpenSession(NewContext().get(), request, &opened).ok());
    std::vector<float> actions;
    for (int64_t step = 0; step < 8; ++step) {
      actions.push_back(client_->Act(opened.session_id(), step).action().continuous().values(0));
    }
    return actions;
  };
  EXPECT_EQ(play(1), play(1));
  EXPECT_NE(play(1), play(2));
}

TEST_F(EpisodeTest, LabelsComeBack) {
  v1::OpenSessionRequest request;
  request.set_policy("box");
  request.mutable_labels()->insert({"robot", "7"});
  v1::OpenSessionResponse opened;
  ASSERT_TRUE(client_->stub().OpenSession(NewContext().get(), request, &opened).ok());
  v1::GetSessionRequest get;
  get.set_session_id(opened.session_id());
  v1::GetSessionResponse view;
  ASSERT_TRUE(client_->stub().GetSession(NewContext().get(), get, &view).ok());
  EXPECT_EQ(view.labels().at("robot"), "7");
}

}  // namespace
}  // namespace spikeserve
