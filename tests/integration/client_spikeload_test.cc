// Tests of the program spikeload with a real server.
#include "absl/strings/str_cat.h"
#include "tests/integration/client_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

class SpikeloadTest : public ClientProgramTest {};

TEST_F(SpikeloadTest, EveryModeRunsWithoutErrors) {
  double total = 0.0;
  for (const std::string mode : {"unary", "stream", "batch"}) {
    SCOPED_TRACE(mode);
    const nlohmann::json load =
        ParseOutput(Spikeload({"--mode=" + mode, "--sessions=20", "--streams=4", "--duration=500ms",
                               "--episode_steps=10", "--policy=cartpole-v1", "--json"}));
    EXPECT_EQ(load.size(), 7u);
    EXPECT_EQ(load["errors"], 0);
    EXPECT_GE(load["decisions"].get<int64_t>(), 20);
    EXPECT_GT(load["decisions_per_second"].get<double>(), 0.0);
    EXPECT_GT(load["p50_seconds"].get<double>(), 0.0);
    EXPECT_GE(load["p99_seconds"].get<double>(), load["p50_seconds"].get<double>());
    // Most sessions have a longest wait above the median of all waits.
    EXPECT_GE(load["longest_wait_p50_seconds"].get<double>(), load["p50_seconds"].get<double>());
    total += load["decisions"].get<double>();
    EXPECT_EQ(Metric("spikeserve_decisions_total"), total);
    EXPECT_EQ(Metric("spikeserve_sessions"), 0.0);
  }
  EXPECT_GT(Metric("spikeserve_episodes_total"), 0.0);
}

TEST_F(SpikeloadTest, EveryEnvironmentsPolicyCanBeLoaded) {
  for (const std::string policy : {"mountaincar-v0", "acrobot-v1", "pendulum-v1"}) {
    const Finished load = Spikeload(
        {"--mode=batch", "--policy=" + policy, "--sessions=5", "--batch_size=2", "--duration=0.2"});
    EXPECT_EQ(load.exit_code, 0) << load.errors;
    EXPECT_THAT(load.output, HasSubstr("\n0 errors\n"));
  }
}

TEST_F(SpikeloadTest, SessionsMayLearn) {
  double updates = 0.0;
  for (const std::string scope : {"session", "fleet"}) {
    for (const std::string policy : {"cartpole-v1", "pendulum-v1"}) {
      SCOPED_TRACE(scope + " " + policy);
      ParseOutput(Spikeload({"--mode=stream", "--policy=" + policy, "--learning_scope=" + scope,
                             "--sessions=8", "--duration=500ms", "--episode_steps=10", "--json"}));
      const double now = Metric("spikeserve_learning_updates_total");
      EXPECT_GT(now, updates);
      updates = now;
    }
  }
  ExpectOneLineError(Spikeload({"--learning_scope=town"}),
                     "--learning_scope: expected session or fleet, received \"town\"");
}

TEST_F(SpikeloadTest, SaysInOneLineWhatIsWrong) {
  ExpectOneLineError(Spikeload({"--mode=pigeon"}),
                     "expected unary, stream or batch, received \"pigeon\"");
  ExpectOneLineError(Spikeload({"--sessions=0"}), "--sessions: expected 1 to 1000000, received 0");
  ExpectOneLineError(Spikeload({"--streams=0"}), "--streams");
  ExpectOneLineError(Spikeload({"--duration=soon"}),
                     "expected a duration such as 250ms, 10s or 1.5m");
  ExpectOneLineError(Spikeload({"--duration=-1"}), "--duration");
  ExpectOneLineError(Spikeload({"--episode_steps=0"}), "--episode_steps");
  ExpectOneLineError(Spikeload({"--policy=nobody"}), "\"nobody\"");
  ExpectOneLineError(Spikeload({"now"}), "expected flags alone, received \"now\"");
}

TEST_F(SpikeloadTest, RefusedSessionsEndTheTest) {
  StartServer({"--max_sessions=10"});
  const Finished load = Spikeload({"--sessions=11", "--streams=1", "--duration=100ms"});
  ExpectOneLineError(load, "RESOURCE_EXHAUSTED");
}

TEST_F(SpikeloadTest, AnUnreachableServerIsNamed) {
  const std::string address = server_->grpc_address();
  server_->Stop();
  ExpectOneLineError(Spikeload({}), absl::StrCat("no server could be reached at ", address));
}

}  // namespace
}  // namespace spikeserve
