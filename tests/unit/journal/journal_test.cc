// Tests of journals: a session that is restored from its journal equals the undisturbed session,
// bit for bit, and damaged journals are refused.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <deque>
#include <nlohmann/json.hpp>
#include <ostream>

#include "absl/functional/function_ref.h"
#include "core/agent/agent_session.h"
#include "core/agent/wiring_check.h"
#include "core/journal/journal_entry.h"
#include "core/journal/session_bytes.h"
#include "core/journal/session_journal.h"
#include "core/model/wiring_fit.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;
using Kind = JournalRecord::Kind;

// Holds records until Acknowledge() or Refuse().
class FakeWriter final : public JournalWriter {
 public:
  void Write(JournalRecord record) override {
    if (record.kind == Kind::kOpen || record.kind == Kind::kSnapshot) bytes_.clear();
    if (record.kind != Kind::kClose) bytes_.push_back(record.bytes);
    kinds_.push_back(record.kind);
    waiting_.push_back(std::move(record));
  }
  void Hurry() override { ++hurries_; }
  absl::Status CheckReachable() const override { return reachable_; }
  absl::Status CheckBacklog() const override { return backlog_; }

  void Acknowledge(const absl::Status& status = absl::OkStatus()) {
    while (!waiting_.empty()) {
      const JournalRecord record = std::move(waiting_.front());
      waiting_.pop_front();
      record.journal->OnWritten(record, status);
    }
  }

  std::vector<std::string> bytes_;  // what a store would hold
  std::vector<Kind> kinds_;
  std::deque<JournalRecord> waiting_;
  int hurries_ = 0;
  absl::Status reachable_;
  absl::Status backlog_;
};

std::shared_ptr<SessionJournal> NewJournal(JournalWriter* writer, Durability durability) {
  return std::make_shared<SessionJournal>(SessionJournal::Key{.id = "id", .tenant = ""}, durability,
                                          /*decisions=*/0, writer);
}

struct JournalCase {
  std::string name;
  ActionSpace action_space;
  ActionSelection selection;
  std::optional<LearningOptions> learning;
  bool observation_changes = false;
  bool is_miswired = false;
};

void PrintTo(const JournalCase& test, std::ostream* out) { *out << test.name; }

std::vector<JournalCase> JournalCases() {
  const ActionSpace discrete = ActionSpace::Discrete(3);
  const ActionSpace box = ActionSpace::Box({-2.0f, 0.0f}, {2.0f, 1.0f});
  const ActionSelection sampled = {.sample = true, .temperature = 0.7f};
  std::vector<JournalCase> cases = {{"GreedyDiscrete", discrete, {}, {}},
                                    {"GreedyBox", box, {}, {}},
                                    {"SampledDiscrete", discrete, sampled, {}},
                                    {"SampledBox", box, sampled, {}},
                                    {"Changes", box, {}, {}, /*observation_changes=*/true},
                                    {"Miswired", discrete, {}, {}, false, /*is_miswired=*/true}};
  for (const auto& [rule, rule_name] : EnumNames(Rule())) {
    for (const Modulator modulator : {Modulator::kTarget, Modulator::kRealized}) {
      const LearningOptions learning = {
          .rule = rule, .modulator = modulator, .learning_rate = 0.05};
      const std::string name =
          std::string(rule_name) + (modulator == Modulator::kTarget ? "Target" : "Realized");
      cases.push_back({name + "Discrete", discrete, sampled, learning});
      cases.push_back({name + "Box", box, sampled, learning});
      cases.push_back({name + "Miswired", box, sampled, learning, false, /*is_miswired=*/true});
      if (modulator == Modulator::kTarget || rule == Rule::kCorrections) continue;
      LearningOptions awaits = learning;
      awaits.verdict_seconds = 3600.0;
      cases.push_back({name + "AwaitsVerdicts", box, sampled, awaits});
    }
  }
  return cases;
}

// Returns the bytes of a session, but for the times at which its episodes ended.
std::string TimelessBytes(Session session) {
  if (session.learner.has_value()) {
    for (auto& ended : session.learner->waiting) {
      WaitingEpisode timeless = *ended;
      timeless.until = 0.0;
      ended = std::make_shared<const WaitingEpisode>(std::move(timeless));
    }
  }
  return SerializeSession(session);
}

class JournalTest : public ::testing::TestWithParam<JournalCase> {
 protected:
  AgentSession NewAgent() {
    SessionOptions options = SmallOptions();
    options.action_selection = GetParam().selection;
    options.learning = GetParam().learning;
    options.labels[kWiringLabel] = GetParam().learning.has_value() ? "safe" : "count";
    return AgentSession(served_, NewSession("id", std::move(options)), &clock_);
  }

  FakeClock clock_;
  static ModelConfig Config() {
    ModelConfig config = SmallConfig();
    config.observation_changes = GetParam().observation_changes;
    return config;
  }
  // Returns a model of observations whose first and last element are exchanged.
  static std::shared_ptr<const WiringModel> OtherWiring() {
    if (!GetParam().is_miswired) return nullptr;
    const auto actions = static_cast<size_t>(GetParam().action_space.size());
    WiringFit fit(kObservationSize, actions);
    std::vector<float> observations;
    for (int64_t t = 0; t <= 100; ++t) {
      const std::vector<float> seen = ObservationAt(t);
      observations.insert(observations.end(), seen.rbegin(), seen.rend());
    }
    fit.Add(observations, std::vector<float>(100 * actions));
    return std::make_shared<const WiringModel>(*fit.Finish());
  }
  std::shared_ptr<const ServedPolicy> served_ =
      Serve(Config(), GetParam().action_space, std::make_shared<SessionObserver>(), OtherWiring());
};

// Returns the action that the agent reports at timestep t: none, the same every few steps, or one
// that may be the answered one.
std::optional<ReportedAction> ExecutedAt(int64_t t, const ActionSpace& space) {
  static constexpr float kValues[] = {-0.5f, 0.75f};
  if (t % 3 != 1) return std::nullopt;
  if (space.is_discrete()) return ReportedAction(t % 2);
  return ReportedAction(absl::MakeConstSpan(kValues));
}

// Restores the session after every step from what the journal holds. Three episodes are longer than
// the interval of snapshots.
TEST_P(JournalTest, ARestoredSessionGoesOnBitForBit) {
  AgentSession steady = NewAgent();
  AgentSession moved = NewAgent();
  FakeWriter writer;
  const auto journal = NewJournal(&writer, Durability::kAsync);
  journal->OnOpen(moved.session());
  moved.AddListener(journal);
  bool was_safe = false;
  for (int episode = 0; episode < 3; ++episode) {
    for (int64_t t = 0; t < 20; ++t) {
      const auto executed = ExecutedAt(t, GetParam().action_space);
      const auto expected = steady.Act(t, ObservationAt(t), RewardAt(t), executed);
      const auto actual = moved.Act(t, ObservationAt(t), RewardAt(t), executed);
      ASSERT_TRUE(expected.ok() && actual.ok());
      ASSERT_EQ(**actual, **expected) << "episode " << episode << ", step " << t;

      auto parsed = ParseJournal(writer.bytes_);
      ASSERT_TRUE(parsed.ok()) << parsed.status();
      auto restored = RestoreSession(*std::move(parsed), served_->policy());
      ASSERT_TRUE(restored.ok()) << restored.status();
      ASSERT_EQ(SerializeSession(*restored), SerializeSession(moved.session()));
      moved = AgentSession(served_, *std::move(restored), &clock_);
      moved.AddListener(journal);
    }
    EXPECT_EQ(moved.acts_safely(), steady.acts_safely());
    was_safe |= moved.acts_safely();
    for (AgentSession* agent : {&steady, &moved}) {
      ASSERT_TRUE(agent->EndEpisode({.reward = 2.0, .terminated = true}).ok());
    }
    EXPECT_EQ(TimelessBytes(moved.session()), TimelessBytes(steady.session()));
  }
  EXPECT_EQ(moved.session().wiring.verdict.has_value(), GetParam().is_miswired);
  EXPECT_EQ(was_safe, GetParam().is_miswired && GetParam().learning.has_value());
}

INSTANTIATE_TEST_SUITE_P(All, JournalTest, ::testing::ValuesIn(JournalCases()),
                         [](const auto& instance) { return instance.param.name; });

class DamagedJournalTest : public ::testing::Test {
 protected:
  DamagedJournalTest() {
    agent_.AddListener(journal_);
    journal_->OnOpen(agent_.session());
    for (int64_t t = 0; t < 4; ++t) (void)agent_.Act(t, ObservationAt(t), RewardAt(t));
  }

  absl::Status Restore(const std::vector<std::string>& records) {
    auto parsed = ParseJournal(records);
    if (!parsed.ok()) return parsed.status();
    return RestoreSession(*std::move(parsed), served_->policy()).status();
  }

  void ExpectDamaged(const std::vector<std::string>& records, const std::string& message) {
    const absl::Status status = Restore(records);
    EXPECT_EQ(status.code(), absl::StatusCode::kDataLoss) << status;
    EXPECT_THAT(std::string(status.message()), HasSubstr(message));
  }

  // Returns a journal of one snapshot, of a session that `damage` has changed.
  static std::vector<std::string> With(Session session, absl::FunctionRef<void(Session&)> damage) {
    damage(session);
    return {SerializeSession(session)};
  }

  // Returns the records with one field of the last entry replaced.
  std::vector<std::string> Edited(const std::string& pointer, const nlohmann::json& value) {
    auto json = nlohmann::json::from_cbor(writer_.bytes_.back());
    json[nlohmann::json::json_pointer(pointer)] = value;
    const auto bytes = nlohmann::json::to_cbor(json);
    std::vector<std::string> records = writer_.bytes_;
    records.back() = std::string(bytes.begin(), bytes.end());
    return records;
  }

  FakeClock clock_;
  FakeWriter writer_;
  std::shared_ptr<const ServedPolicy> served_ = Serve(SmallConfig(), ActionSpace::Discrete(3));
  AgentSession agent_{served_, NewSession("id", SmallOptions()), &clock_};
  std::shared_ptr<SessionJournal> journal_ = NewJournal(&writer_, Durability::kSync);
};

TEST_F(DamagedJournalTest, EveryTruncationOfEveryRecordIsDetected) {
  ASSERT_TRUE(Restore(writer_.bytes_).ok());
  for (size_t i = 0; i < writer_.bytes_.size(); ++i) {
    const std::string& whole = writer_.bytes_[i];
    for (size_t size = 0; size < whole.size(); ++size) {
      std::vector<std::string> records = writer_.bytes_;
      records[i] = whole.substr(0, size);
      ASSERT_EQ(Restore(records).code(), absl::StatusCode::kDataLoss) << i << " " << size;
    }
  }
}

// Changing one byte gives another valid journal or a clear error. It never crashes.
TEST_F(DamagedJournalTest, NoByteThatChangesCrashesTheReader) {
  for (size_t i = 0; i < writer_.bytes_.size(); ++i) {
    for (size_t at = 0; at < writer_.bytes_[i].size(); ++at) {
      for (const char flip : {'\x01', '\x20', '\x80', '\xff'}) {
        std::vector<std::string> records = writer_.bytes_;
        records[i][at] = static_cast<char>(records[i][at] ^ flip);
        const absl::Status status = Restore(records);
        ASSERT_TRUE(status.ok() || status.code() == absl::StatusCode::kDataLoss) << status;
      }
    }
  }
}

TEST_F(DamagedJournalTest, WrongRecordsAreNamed) {
  ExpectDamaged({}, "expected a snapshot, received 0 records");
  ExpectDamaged({writer_.bytes_[1]}, "expected a snapshot, received 1 records");
  ExpectDamaged({writer_.bytes_[0], "x"}, "record 1 of 2: entry: expected CBOR");
  ExpectDamaged({writer_.bytes_[0], std::string(1'000'000, '\x81')}, "record 1 of 2");
  ExpectDamaged(Edited("/0", "spikeserve.decision.v2"), "spikeserve.decision.v1");
  ExpectDamaged(Edited("/1/2", nlohmann::json::array()), "observation: expected 3 numbers");
  ExpectDamaged(Edited("/1/3", {5, nlohmann::json::array()}),
                "action: expected 0 to 2, received 5");
  ExpectDamaged(Edited("/1/4/1/0", 3), "action: expected 0 to 2, received 3");
  ExpectDamaged(Edited("/1/4/7", nlohmann::json::array()), "logits: expected 3 numbers");
  ExpectDamaged(Edited("/1/4/2", nlohmann::json::array()), "probabilities: expected 3 numbers");
}

// A writer that finds out too late that the store has lost records leaves one behind the gap.
TEST_F(DamagedJournalTest, AJournalEndsBeforeItsFirstGap) {
  auto parsed = ParseJournal(
      {writer_.bytes_[0], writer_.bytes_[1], writer_.bytes_[1], writer_.bytes_[3], "x"});
  ASSERT_TRUE(parsed.ok()) << parsed.status();
  EXPECT_EQ(parsed->after_gap, 2u);
  const auto session = RestoreSession(*std::move(parsed), served_->policy());
  ASSERT_TRUE(session.ok()) << session.status();
  EXPECT_EQ(session->decisions, 1u);
}

TEST_F(DamagedJournalTest, ASnapshotOfAnotherPolicyIsRefused) {
  const auto box = Serve(SmallConfig(), ActionSpace::Box({-1.0f, 0.0f}, {1.0f, 1.0f}));
  auto parsed = ParseJournal({SerializeSession(agent_.session())});
  ASSERT_TRUE(parsed.ok()) << parsed.status();
  EXPECT_EQ(RestoreSession(*std::move(parsed), box->policy()).status().code(),
            absl::StatusCode::kDataLoss);
}

// An executed action replaces the last answer and its factors by index.
TEST_F(DamagedJournalTest, ASnapshotWhoseLastAnswerDoesNotFitIsRefused) {
  SessionOptions options = SmallOptions();
  options.learning = LearningOptions();
  AgentSession learning(served_, NewSession("id", options), &clock_);
  ASSERT_TRUE(learning.Act(0, ObservationAt(0), 0.0).ok());
  ExpectDamaged(With(learning.session(), [](Session& s) { s.last_answer->action.discrete = 3; }),
                "action: expected 0 to 2, received 3");
  ExpectDamaged(With(learning.session(), [](Session& s) { s.last_answer->logits.pop_back(); }),
                "logits: expected 3 numbers, received 2");
  ExpectDamaged(
      With(learning.session(), [](Session& s) { s.last_answer->action.continuous = {1.0f}; }),
      "action: expected 0 numbers, received 1");
  ExpectDamaged(With(learning.session(),
                     [](Session& s) {  // the head has 3 x 16 weights
                       s.learner->post.setZero(1);
                       s.learner->readout.setZero(48);
                     }),
                "learner.post: expected 3 numbers, received 1");
}

class SessionJournalTest : public DamagedJournalTest {
 protected:
  // Returns the outcome of waiting for everything that was written; nullopt while it waits.
  std::shared_ptr<std::optional<absl::Status>> Wait() {
    auto outcome = std::make_shared<std::optional<absl::Status>>();
    journal_->WhenDurable(journal_->written(),
                          [outcome](const absl::Status& status) { *outcome = status; });
    return outcome;
  }
};

TEST_F(SessionJournalTest, AnAnswerThatWaitsHurriesTheWriter) {
  EXPECT_EQ(writer_.hurries_, 0);
  const auto outcome = Wait();
  EXPECT_EQ(writer_.hurries_, 1);
  writer_.Acknowledge();
  EXPECT_TRUE(outcome->has_value());
  Wait();  // for what the store has
  EXPECT_EQ(writer_.hurries_, 1);
}

TEST_F(SessionJournalTest, AnswersWaitForTheirRecordAndNoOther) {
  const auto outcome = Wait();
  (void)agent_.Act(4, ObservationAt(4), 0.0);
  EXPECT_FALSE(outcome->has_value());
  EXPECT_EQ(journal_->durable_decisions(), 0u);
  while (writer_.waiting_.size() > 1) {
    const JournalRecord record = writer_.waiting_.front();
    writer_.waiting_.pop_front();
    EXPECT_FALSE(outcome->has_value());
    journal_->OnWritten(record, absl::OkStatus());
  }
  ASSERT_TRUE(outcome->has_value());
  EXPECT_TRUE((*outcome)->ok());
  EXPECT_EQ(journal_->durable_decisions(), 4u);
}

TEST_F(SessionJournalTest, ASnapshotReplacesTheSixteenthEntryAndEveryEndOfAnEpisode) {
  for (int64_t t = 4; t < 20; ++t) (void)agent_.Act(t, ObservationAt(t), 0.0);
  ASSERT_TRUE(agent_.EndEpisode({.reward = 1.0}).ok());
  ASSERT_EQ(writer_.kinds_.size(), 22u);
  EXPECT_EQ(writer_.kinds_[0], Kind::kOpen);
  EXPECT_EQ(writer_.kinds_[16], Kind::kSnapshot);
  EXPECT_EQ(writer_.kinds_[21], Kind::kSnapshot);
  EXPECT_EQ(std::count(writer_.kinds_.begin(), writer_.kinds_.end(), Kind::kSnapshot), 2);
}

TEST_F(SessionJournalTest, AFormerOwnerIsLost) {
  const auto outcome = Wait();
  writer_.Acknowledge(absl::AbortedError("epoch"));
  ASSERT_TRUE(outcome->has_value());
  EXPECT_EQ((*outcome)->code(), absl::StatusCode::kUnavailable);
  EXPECT_TRUE(journal_->lost());
  EXPECT_EQ((*Wait())->code(), absl::StatusCode::kUnavailable);
  journal_->OnClose();  // must not close the session of the new owner
  EXPECT_TRUE(writer_.waiting_.empty());
}

// The answer waits for a snapshot that replaces all that was lost.
TEST_F(SessionJournalTest, WhatTheStoreHasLostIsWrittenAgain) {
  writer_.Acknowledge();
  EXPECT_EQ(journal_->stored().base, 1u);
  EXPECT_EQ(journal_->stored().records, 5u);
  (void)agent_.Act(4, ObservationAt(4), 0.0);
  (void)agent_.Act(5, ObservationAt(5), 0.0);
  const auto outcome = Wait();
  const JournalRecord refused = writer_.waiting_.front();
  writer_.waiting_.pop_front();
  journal_->OnWritten(refused, absl::NotFoundError("lost"));
  EXPECT_TRUE(journal_->missing());
  const JournalRecord replaced = writer_.waiting_.front();
  writer_.waiting_.pop_front();
  EXPECT_TRUE(journal_->IsReplaced(replaced));
  EXPECT_FALSE(outcome->has_value());
  journal_->WriteAgainIfMissing(agent_.session());
  EXPECT_EQ(writer_.kinds_.back(), Kind::kOpen);
  EXPECT_FALSE(journal_->IsReplaced(writer_.waiting_.front()));
  writer_.Acknowledge();
  ASSERT_TRUE(outcome->has_value());
  EXPECT_TRUE((*outcome)->ok());
  EXPECT_EQ(journal_->durable_decisions(), 6u);
  EXPECT_EQ(journal_->stored().records, 1u);
}

TEST_F(SessionJournalTest, AQuestionIsNoRecord) {
  writer_.Acknowledge();
  journal_->OnConfirm();
  const auto outcome = Wait();
  EXPECT_EQ(writer_.waiting_.front().records, 5u);
  writer_.Acknowledge(absl::AbortedError("epoch"));
  ASSERT_TRUE(outcome->has_value());
  EXPECT_EQ((*outcome)->code(), absl::StatusCode::kUnavailable);
  EXPECT_TRUE(journal_->lost());
}

TEST_F(SessionJournalTest, WaitersDoNotWaitForAStoreThatIsAway) {
  const auto outcome = Wait();
  writer_.reachable_ = absl::UnavailableError("away");
  journal_->OnUnreachable(writer_.reachable_);
  ASSERT_TRUE(outcome->has_value());
  EXPECT_EQ((*outcome)->code(), absl::StatusCode::kUnavailable);
  EXPECT_EQ(journal_->CheckWritable().code(), absl::StatusCode::kUnavailable);
  EXPECT_EQ((*Wait())->code(), absl::StatusCode::kUnavailable);
  writer_.reachable_ = absl::OkStatus();
  writer_.Acknowledge();  // written later all the same
  EXPECT_TRUE((*Wait())->ok());
  EXPECT_EQ(journal_->durable_decisions(), 4u);
}

TEST_F(SessionJournalTest, AnAsynchronousSessionOutrunsItsStoreByABoundedNumber) {
  AgentSession agent(served_, NewSession("id", SmallOptions()), &clock_);
  const auto journal = NewJournal(&writer_, Durability::kAsync);
  agent.AddListener(journal);
  writer_.reachable_ = absl::UnavailableError("away");
  int64_t t = 0;
  for (; journal->CheckWritable().ok(); ++t) (void)agent.Act(t, ObservationAt(t), 0.0);
  EXPECT_EQ(t, 256);
  writer_.Acknowledge();
  EXPECT_TRUE(journal->CheckWritable().ok());
  writer_.backlog_ = absl::UnavailableError("full");
  EXPECT_EQ(journal->CheckWritable().code(), absl::StatusCode::kUnavailable);
}

}  // namespace
}  // namespace spikeserve
