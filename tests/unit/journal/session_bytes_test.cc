#include "core/journal/session_bytes.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "core/session/session.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;
using Json = nlohmann::json;

// Returns a session in the middle of its second episode, with all fields set.
Session BusySession() {
  const auto served = Serve(SmallConfig(), ActionSpace::Box({-2.0f, -1.0f}, {2.0f, 1.0f}));
  FakeClock clock;
  SessionOptions options = SmallOptions();
  options.seed = ~uint64_t{0};
  options.action_selection = {.sample = true, .temperature = 0.3f};
  options.labels = {{"robot", "7"}, {"site", "Zürich"}};
  AgentSession agent(served, NewSession("0123", options), &clock);
  (void)agent.Act(0, ObservationAt(0), 0.0);
  (void)agent.EndEpisode({.reward = 1.0, .target_return = -0.1});
  for (int64_t t = 0; t < 12; ++t) (void)agent.Act(t, ObservationAt(t), RewardAt(t));
  return agent.session();
}

std::string Edited(const Session& session, const std::string& pointer, const Json& value) {
  Json json = Json::from_cbor(SerializeSession(session));
  json[Json::json_pointer(pointer)] = value;
  const std::vector<uint8_t> bytes = Json::to_cbor(json);
  return std::string(bytes.begin(), bytes.end());
}

void ExpectRefused(const std::string& bytes, const std::string& message) {
  const auto parsed = ParseSession(bytes);
  ASSERT_FALSE(parsed.ok());
  EXPECT_EQ(parsed.status().code(), absl::StatusCode::kInvalidArgument);
  EXPECT_THAT(std::string(parsed.status().message()), HasSubstr(message));
}

TEST(SessionTest, RoundTripKeepsEveryField) {
  const Session session = BusySession();
  const auto parsed = ParseSession(SerializeSession(session));
  ASSERT_TRUE(parsed.ok()) << parsed.status();
  EXPECT_EQ(parsed->id, session.id);
  EXPECT_EQ(parsed->options.policy, session.options.policy);
  EXPECT_EQ(parsed->options.version, session.options.version);
  EXPECT_EQ(parsed->options.target_return, session.options.target_return);
  EXPECT_EQ(parsed->options.seed, session.options.seed);
  EXPECT_EQ(parsed->options.action_selection.sample, true);
  EXPECT_EQ(parsed->options.action_selection.temperature, 0.3f);
  EXPECT_EQ(parsed->options.labels, session.options.labels);
  EXPECT_EQ(parsed->episode, 1);
  EXPECT_EQ(parsed->step, 12);
  EXPECT_EQ(parsed->target_return, -0.1);
  EXPECT_EQ(parsed->return_to_go, session.return_to_go);
  EXPECT_EQ(parsed->episode_return, session.episode_return);
  EXPECT_EQ(parsed->episode_spikes, session.episode_spikes);
  EXPECT_EQ(parsed->episode_energy_joules, session.episode_energy_joules);
  EXPECT_EQ(parsed->history, session.history);
  EXPECT_EQ(parsed->last_answer, session.last_answer);
  EXPECT_EQ(parsed->decisions, 13u);
  EXPECT_EQ(parsed->spikes, session.spikes);
  EXPECT_EQ(parsed->energy_joules, session.energy_joules);
}

// Releases that do not know the counts of integer arithmetic read the answers of other policies.
TEST(SessionTest, CountsOfIntegerArithmeticFollowOnlyWhereThereAreAny) {
  Session session = BusySession();
  const Json::json_pointer counts_of_answer("/1/10/4");
  EXPECT_EQ(Json::from_cbor(SerializeSession(session))[counts_of_answer].size(), 10u);
  Counts& counts = session.last_answer->counts;
  counts.driven_neurons = 1;
  counts.membrane_leaks = 2;
  counts.wide_multiply_accumulates = 3;
  counts.attention_scalings = 4;
  counts.weight_bytes = 5;
  counts.attention_bytes = 6;
  EXPECT_EQ(Json::from_cbor(SerializeSession(session))[counts_of_answer].size(), 16u);
  const auto parsed = ParseSession(SerializeSession(session));
  ASSERT_TRUE(parsed.ok()) << parsed.status();
  EXPECT_EQ(parsed->last_answer->counts, counts);
}

TEST(SessionTest, BrokenBytesAreRefused) {
  const std::string bytes = SerializeSession(BusySession());
  for (size_t size = 0; size < bytes.size(); ++size) {
    ASSERT_FALSE(ParseSession(bytes.substr(0, size)).ok()) << size;
  }
  ExpectRefused(bytes + "x", "expected CBOR");
  ExpectRefused("not a session", "expected CBOR");
  ExpectRefused(std::string(1'000'000, '\x81'), "expected CBOR");  // nested arrays
}

TEST(SessionTest, WrongFieldsAreNamed) {
  const Session session = BusySession();
  ExpectRefused(Edited(session, "/0", "spikeserve.session.v2"), "spikeserve.session.v1");
  ExpectRefused(Edited(session, "/1/-", 1), "session.wiring: expected an array of 6");
  ExpectRefused(Edited(session, "/1/0", 1), "session.id: expected a string, received 1");
  ExpectRefused(Edited(session, "/1/1/1", 0), "session.options.version: expected at least 1");
  ExpectRefused(Edited(session, "/1/1/3", -1), "session.options.seed: expected an integer");
  ExpectRefused(Edited(session, "/1/3", -1), "session.step: expected at least 0, received -1");
  ExpectRefused(Edited(session, "/1/3", 11), "session.last_answer.step: expected 10, received 11");
  ExpectRefused(Edited(session, "/1/9/2/1/0", "x"), "session.history[2].observation[0]: expected");
  ExpectRefused(Edited(session, "/1/9/2/1", Json::array()),
                "session.history[2]: expected as many numbers as timestep 0 has");
  ExpectRefused(Edited(session, "/1/9", Json::array()), "session.history: expected 1 to 12");
  ExpectRefused(Edited(session, "/1/10", nullptr), "session.last_answer.step: expected 11");
  ExpectRefused(
      Edited(session, "/1/11",
             {{1.0, false, nullptr, false, Json::array(), nullptr}, {1.0, 1, 1u, 1.0, nullptr}}),
      "session.last_end: expected one if and only if an episode has ended");
  ExpectRefused(Edited(session, "/1/10/4/0", {1, 2}),
                "session.last_answer.counts.spikes_by_stage: expected an array of 8");
  ExpectRefused(Edited(session, "/1/5", std::numeric_limits<double>::infinity()),
                "session.return_to_go: expected a finite floating-point number");
}

}  // namespace
}  // namespace spikeserve
