// Tests that the metrics agree with the answers that the agents received.
#include <chrono>
#include <fstream>
#include <memory>
#include <vector>

#include "tests/integration/http_client.h"
#include "tests/integration/server_fixture.h"
#include "tests/integration/subprocess.h"

namespace spikeserve {
namespace {

class MetricsTest : public ServerTest {};

TEST_F(MetricsTest, CountersGrowByExactlyWhatTheAnswersSay) {
  v1::DecisionStats sum;
  uint64_t hidden = 0;
  const auto add = [&](const v1::DecisionStats& stats) {
    sum.set_spikes(sum.spikes() + stats.spikes());
    sum.set_accumulates(sum.accumulates() + stats.accumulates());
    sum.set_multiply_accumulates(sum.multiply_accumulates() + stats.multiply_accumulates());
    sum.set_attention_products(sum.attention_products() + stats.attention_products());
    sum.set_energy_joules(sum.energy_joules() + stats.energy_joules());
    sum.set_membrane_updates(sum.membrane_updates() + stats.membrane_updates());
    sum.set_layer_norm_elements(sum.layer_norm_elements() + stats.layer_norm_elements());
    sum.set_softmax_terms(sum.softmax_terms() + stats.softmax_terms());
    sum.set_gate_products(sum.gate_products() + stats.gate_products());
    sum.set_coder_gains(sum.coder_gains() + stats.coder_gains());
    hidden += stats.spikes_by_stage().ffn_hidden();
  };
  for (const std::string policy : {"discrete", "box"}) {
    const std::string session = client_->Open(policy);
    for (int64_t step = 0; step < 9; ++step) {
      add(client_->Act(session, step).stats());
      client_->Act(session, step);                         // a retry
      client_->TryAct(MakeActRequest(session, step + 5));  // an error
    }
    client_->EndEpisode(session, 0.0);
  }
  EXPECT_EQ(Metric("spikeserve_decisions_total"), 18.0);
  EXPECT_EQ(Metric("spikeserve_spikes_total"), static_cast<double>(sum.spikes()));
  EXPECT_EQ(Metric("spikeserve_spikes_total", {"stage=\"ffn_hidden\""}),
            static_cast<double>(hidden));
  EXPECT_EQ(Metric("spikeserve_spikes_per_decision_sum"), static_cast<double>(sum.spikes()));
  const std::string operations = "spikeserve_synaptic_operations_total";
  EXPECT_EQ(Metric(operations, {"kind=\"accumulate\""}), static_cast<double>(sum.accumulates()));
  EXPECT_EQ(Metric(operations, {"kind=\"multiply_accumulate\""}),
            static_cast<double>(sum.multiply_accumulates()));
  EXPECT_EQ(Metric(operations, {"kind=\"attention\""}),
            static_cast<double>(sum.attention_products()));
  const std::string energy = "spikeserve_energy_joules_total";
  EXPECT_NEAR(Metric(energy, {"energy_model=\"spike_5pj\""}),
              5e-12 * static_cast<double>(sum.spikes()), 1e-18);
  EXPECT_NEAR(Metric(energy, {"energy_model=\"horowitz_45nm\""}), sum.energy_joules(), 1e-17);
  EXPECT_EQ(Metric("spikeserve_membrane_updates_total"),
            static_cast<double>(sum.membrane_updates()));
  const std::string others = "spikeserve_other_operations_total";
  EXPECT_EQ(Metric(others, {"kind=\"coder_gain\""}), static_cast<double>(sum.coder_gains()));
  EXPECT_EQ(Metric(others, {"kind=\"layer_norm_element\""}),
            static_cast<double>(sum.layer_norm_elements()));
  EXPECT_EQ(Metric(others, {"kind=\"softmax_term\""}), static_cast<double>(sum.softmax_terms()));
  EXPECT_EQ(Metric(others, {"kind=\"gate_product\""}), static_cast<double>(sum.gate_products()));
  // The policies are in float32.
  EXPECT_THAT(Page("/metrics"), ::testing::Not(::testing::HasSubstr("int_45nm")));
}

TEST_F(MetricsTest, EpisodesAndTheirReturns) {
  const std::string session = client_->Open();
  for (const double reward : {-30.0, 10.0}) {
    client_->Act(session, 0);
    client_->EndEpisode(session, reward);
  }
  EXPECT_EQ(Metric("spikeserve_episodes_total", {"policy=\"discrete\"", "version=\"2\""}), 2.0);
  EXPECT_EQ(Metric("spikeserve_episode_return_bucket",
                   {"policy=\"discrete\"", "version=\"2\"", "le=\"-20\""}),
            1.0);
  EXPECT_EQ(Metric("spikeserve_episode_return_sum"), -20.0);
  EXPECT_EQ(Metric("spikeserve_episode_return_mean", {"policy=\"discrete\"", "version=\"2\""}),
            -10.0);
}

TEST_F(MetricsTest, LearningIsCounted) {
  v1::OpenSessionRequest open;
  open.set_policy("discrete");
  open.mutable_learning()->set_modulator("target");
  open.mutable_learning()->set_learning_rate(0.1);
  open.mutable_learning()->set_max_drift(0.001);
  v1::OpenSessionResponse opened;
  ASSERT_TRUE(client_->stub().OpenSession(NewContext().get(), open, &opened).ok());
  for (int64_t step = 0; step < 9; ++step) {
    client_->Act(opened.session_id(), step);
    client_->Act(opened.session_id(), step);  // a retry
  }
  const v1::LearningSummary learned = client_->EndEpisode(opened.session_id(), 0.0).learning();
  EXPECT_EQ(learned.updates(), 9);
  EXPECT_EQ(learned.rejected_updates(), 0);
  EXPECT_NEAR(learned.head_drift(), 0.001, 1e-9);
  EXPECT_EQ(Metric("spikeserve_learning_updates_total"), 9.0);
  EXPECT_EQ(Metric("spikeserve_learning_rejected_total", {"reason=\"non_finite\""}), 0.0);
  EXPECT_NEAR(Metric("spikeserve_head_drift_ratio",
                     {"policy=\"discrete\"", "scope=\"session\"", "version=\"2\""}),
              learned.head_drift(), 1e-9);
}

TEST_F(MetricsTest, CallsAreTimedByMethodAndCode) {
  const std::string session = client_->Open();
  client_->Act(session, 0);
  client_->TryAct(MakeActRequest(session, 9));
  client_->TryAct(MakeActRequest("nobody", 0));
  auto context = NewContext();
  const auto stream = client_->stub().ActStream(context.get());
  v1::ActResponse response;
  ASSERT_TRUE(stream->Write(MakeActRequest(session, 1)) && stream->Read(&response));
  const auto calls = [&](const std::string& method, const std::string& code) {
    return Metric("spikeserve_rpc_duration_seconds_count",
                  {"method=\"" + method + "\"", "code=\"" + code + "\""});
  };
  EXPECT_EQ(calls("OpenSession", "OK"), 1.0);
  EXPECT_EQ(calls("Act", "OK"), 1.0);
  EXPECT_EQ(calls("Act", "FAILED_PRECONDITION"), 1.0);
  EXPECT_EQ(calls("Act", "NOT_FOUND"), 1.0);
  EXPECT_EQ(calls("ActStream", "OK"), 1.0);
  EXPECT_EQ(Metric("spikeserve_decision_duration_seconds_count"), 2.0);
  EXPECT_THAT(Page("/metrics"), ::testing::HasSubstr("le=\"5e-06\""));
}

TEST_F(MetricsTest, WhatIsServedIsSaid) {
  EXPECT_EQ(Metric("spikeserve_policy_info", {"policy=\"discrete\"", "version=\"1\"",
                                              "environment=\"Test-v0\"", "mode=\"full\""}),
            1.0);
  EXPECT_EQ(Metric("spikeserve_build_info", {"version=\""}), 1.0);
}

TEST_F(MetricsTest, AVersionHasSeriesOfSessionsFromItsFirstSessionOn) {
  const std::string before = Page("/metrics");
  EXPECT_THAT(before, ::testing::HasSubstr("spikeserve_non_finite_answers_total{policy="));
  EXPECT_THAT(before, ::testing::Not(::testing::HasSubstr("spikeserve_sessions{")));
  EXPECT_THAT(before, ::testing::Not(::testing::HasSubstr("spikeserve_decisions_total{")));
  client_->Open("discrete");
  const std::string after = Page("/metrics");
  const std::string labels = "{policy=\"discrete\",version=\"2\"}";
  EXPECT_THAT(after, ::testing::HasSubstr("spikeserve_sessions" + labels + " 1\n"));
  EXPECT_THAT(after, ::testing::HasSubstr("spikeserve_decisions_total" + labels + " 0\n"));
  EXPECT_THAT(after, ::testing::Not(::testing::HasSubstr("spikeserve_sessions{policy=\"box\"")));
}

TEST_F(MetricsTest, TheLimitOfSessionsIsTheOneGiven) {
  StartServer({"--max_sessions=7"});
  EXPECT_EQ(Metric("spikeserve_sessions_limit"), 7.0);
}

TEST_F(MetricsTest, TheProcessSaysWhatItTakes) {
  const auto now =
      std::chrono::duration<double>(std::chrono::system_clock::now().time_since_epoch());
  // The tolerance is large, because the boot time in /proc does not follow every change of the
  // clock.
  EXPECT_NEAR(Metric("process_start_time_seconds"), now.count(), 600.0);
  EXPECT_GT(Metric("process_cpu_seconds_total"), 0.0);
  EXPECT_GT(Metric("process_resident_memory_bytes"), 1e6);
  const double open = Metric("process_open_fds");
  EXPECT_GT(open, 3.0);
  EXPECT_LT(open, Metric("process_max_fds"));
  // Every channel gets a connection of its own; by default, channels to one address share theirs.
  // There are several, because sockets of the pages read so far may close in the meantime.
  grpc::ChannelArguments arguments;
  arguments.SetInt(GRPC_ARG_USE_LOCAL_SUBCHANNEL_POOL, 1);
  std::vector<std::shared_ptr<grpc::Channel>> others;
  for (int i = 0; i < 8; ++i) {
    others.push_back(grpc::CreateCustomChannel(server_->grpc_address(),
                                               grpc::InsecureChannelCredentials(), arguments));
    ASSERT_TRUE(others.back()->WaitForConnected(std::chrono::system_clock::now() +
                                                std::chrono::seconds(10)));
  }
  EXPECT_GT(Metric("process_open_fds"), open);
}

TEST_F(MetricsTest, PromtoolIsContent) {
  const std::string session = client_->Open();
  client_->Act(session, 0);
  client_->EndEpisode(session, -1.0);
  const TemporaryDirectory directory;
  const std::string page = (directory.path() / "metrics").string();
  std::ofstream(page) << Page("/metrics");
  const auto finished = RunToEnd({"/bin/sh", "-c", "promtool check metrics < " + page + " 2>&1"});
  ASSERT_TRUE(finished.ok()) << finished.status();
  EXPECT_EQ(finished->exit_code, 0) << finished->output;
  EXPECT_EQ(finished->output, "");
}

TEST_F(MetricsTest, OtherPages) {
  EXPECT_THAT(Page("/"), ::testing::AllOf(::testing::HasSubstr("href=\"metrics\""),
                                          ::testing::HasSubstr("href=\"healthz\"")));
  const auto reply = HttpGet(server_->http_address(), "/etc/passwd");
  ASSERT_TRUE(reply.ok()) << reply.status();
  EXPECT_EQ(reply->code, 404);
}

}  // namespace
}  // namespace spikeserve
