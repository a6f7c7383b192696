// Tests of beats: a session whose robot decided by itself for a while, and told the server
// afterwards, equals the undisturbed session, bit for bit.
#include <gtest/gtest.h>

#include <limits>
#include <ostream>
#include <random>

#include "absl/strings/str_cat.h"
#include "core/agent/agent_session.h"
#include "core/journal/journal_entry.h"
#include "core/journal/session_bytes.h"
#include "core/journal/session_export.h"
#include "core/journal/session_journal.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"
#include "tests/support/session_fixture.h"

namespace spikeserve {
namespace {

// Holds what a store would hold.
class MemoryWriter final : public JournalWriter {
 public:
  void Write(JournalRecord record) override {
    if (record.kind != JournalRecord::Kind::kEntry) records_.clear();
    records_.push_back(record.bytes);
  }
  void Hurry() override {}
  absl::Status CheckReachable() const override { return absl::OkStatus(); }
  absl::Status CheckBacklog() const override { return absl::OkStatus(); }

  std::vector<std::string> records_;
};

// What a robot did, with memory of its own.
struct DoneBeat {
  std::vector<float> observation;
  double reward;
  Action executed;
};

ReportedAction Reported(const Action& action, const ActionSpace& space) {
  if (space.is_discrete()) return int64_t{action.discrete};
  return absl::MakeConstSpan(action.continuous);
}

struct BeatCase {
  std::string name;
  ActionSpace action_space;
  ActionSelection selection = {};
  std::optional<LearningOptions> learning = std::nullopt;
  Arithmetic arithmetic = Arithmetic::kFloat32;
};

void PrintTo(const BeatCase& test, std::ostream* out) { *out << test.name; }

std::vector<BeatCase> BeatCases() {
  const ActionSpace discrete = ActionSpace::Discrete(3);
  const ActionSpace box = ActionSpace::Box({-2.0f, 0.0f}, {2.0f, 1.0f});
  const ActionSelection sampled = {.sample = true, .temperature = 0.7f};
  std::vector<BeatCase> cases = {{"GreedyDiscrete", discrete},
                                 {"GreedyBox", box},
                                 {"SampledBox", box, sampled},
                                 {"Integer", discrete, sampled, {}, Arithmetic::kInteger},
                                 {"IntegerLearning", box, sampled,
                                  LearningOptions{.learning_rate = 0.05}, Arithmetic::kInteger}};
  for (const auto& [rule, rule_name] : EnumNames(Rule())) {
    for (const Modulator modulator : {Modulator::kTarget, Modulator::kRealized}) {
      const LearningOptions learning = {
          .rule = rule, .modulator = modulator, .learning_rate = 0.05};
      cases.push_back(
          {absl::StrCat(rule_name, modulator == Modulator::kTarget ? "Target" : "Realized"),
           discrete, sampled, learning});
    }
  }
  return cases;
}

class BeatsTest : public ::testing::TestWithParam<BeatCase> {
 protected:
  AgentSession NewAgent(std::shared_ptr<const ServedPolicy> served) {
    SessionOptions options = SmallOptions();
    options.action_selection = GetParam().selection;
    options.learning = GetParam().learning;
    return AgentSession(std::move(served), NewSession("id", std::move(options)), &clock_);
  }
  AgentSession NewAgent() { return NewAgent(served_); }

  static ModelConfig Config() {
    ModelConfig config = SmallConfig();
    config.arithmetic = GetParam().arithmetic;
    return config;
  }

  // Applies the history of the last `count` of `done` to `agent`, and `more`, before the step
  // behind them, whose number in the session is `decision`.
  StepOutcome Apply(AgentSession& agent, const std::vector<DoneBeat>& done, size_t count,
                    uint64_t decision, Step more = {}, int64_t most = kAll) {
    std::vector<PastStep> past;
    for (size_t i = done.size() - count; i < done.size(); ++i) {
      past.push_back({.step = static_cast<int64_t>(i),
                      .observation = done[i].observation,
                      .reward = done[i].reward,
                      .executed = Reported(done[i].executed, GetParam().action_space)});
    }
    more.session = &agent;
    more.place.step = static_cast<int64_t>(done.size());
    more.place.decision = decision;
    more.history = {.size = count, .source = past.data(), .read = [](const void* source, size_t i) {
                      return static_cast<const PastStep*>(source)[i];
                    }};
    StepBudget budget = {.steps = most};
    AgentSession::Apply({&more}, &budget);
    EXPECT_TRUE(more.result.status.ok()) << more.result.status;
    return more.result;
  }
  static constexpr int64_t kAll = std::numeric_limits<int64_t>::max();

  FakeClock clock_;
  std::shared_ptr<RecordingObserver> observer_ = std::make_shared<RecordingObserver>();
  std::shared_ptr<const ServedPolicy> served_ = Serve(Config(), GetParam().action_space);
  std::shared_ptr<const ServedPolicy> observed_ =
      Serve(Config(), GetParam().action_space, observer_);
};

// The robot decides some beats by itself, with the session that it has exported. It executes its
// own decisions, or holds an older action; the undisturbed session is told the same.
TEST_P(BeatsTest, ACutSessionEqualsTheUndisturbedOne) {
  std::mt19937 random(3);
  AgentSession steady = NewAgent();
  AgentSession cut = NewAgent(observed_);
  MemoryWriter writer;
  const auto journal = std::make_shared<SessionJournal>(
      SessionJournal::Key{.id = "id", .tenant = ""}, Durability::kAsync, 0, &writer);
  journal->OnOpen(cut.session());
  cut.AddListener(journal);
  size_t asked = 0;
  for (int episode = 0; episode < 2; ++episode) {
    std::vector<DoneBeat> done;
    std::optional<Action> executed;  // before the next step
    int64_t t = 0;
    while (t < 60) {
      const int64_t away = t + static_cast<int64_t>(random() % 9);
      auto imported = ImportSession(ExportSession(cut));
      ASSERT_TRUE(imported.ok()) << imported.status();
      AgentSession local(served_, *std::move(imported), &clock_);
      const size_t before = done.size();
      for (; t <= away; ++t) {
        const auto told =
            executed.has_value()
                ? std::optional<ReportedAction>(Reported(*executed, GetParam().action_space))
                : std::nullopt;
        const auto expected = steady.Act(t, ObservationAt(t), RewardAt(t), told);
        ASSERT_TRUE(expected.ok()) << expected.status();
        if (t < away) {
          const auto decided = local.Act(t, ObservationAt(t), RewardAt(t), told);
          ASSERT_TRUE(decided.ok()) << decided.status();
          ASSERT_EQ(**decided, **expected) << "step " << t;
        } else {
          // The link is back: the history, then a decision.
          const size_t known = done.size() - before + (before > 0 ? 1 : 0);
          if (known > 0) {
            // `steady` has decided this step.
            const auto taken = Apply(cut, done, known, steady.session().decisions - 1);
            EXPECT_EQ(taken.appended, static_cast<int64_t>(done.size() - before));
          }
          const auto decided = cut.Act(t, ObservationAt(t), RewardAt(t), told);
          ASSERT_TRUE(decided.ok()) << decided.status();
          ASSERT_EQ(**decided, **expected) << "step " << t;
          ++asked;
        }
        // Every fifth action is not the answered one.
        executed = t % 5 == 3 && !done.empty() ? done.back().executed : (*expected)->action;
        done.push_back({ObservationAt(t), RewardAt(t), *executed});
      }
      ASSERT_EQ(ExportSession(cut), ExportSession(steady)) << "step " << t;
      const auto restored = RestoreSession(*ParseJournal(writer.records_), served_->policy());
      ASSERT_TRUE(restored.ok()) << restored.status();
      ASSERT_EQ(SerializeSession(*restored), SerializeSession(cut.session())) << "step " << t;
    }
    for (AgentSession* agent : {&steady, &cut}) {
      ASSERT_TRUE(agent->EndEpisode({.reward = 2.0, .terminated = true}).ok());
    }
    ASSERT_EQ(ExportSession(cut), ExportSession(steady));
  }
  EXPECT_EQ(observer_->decisions.size(), asked);
}

// An engine on the robot that plays step by step does the same.
TEST_P(BeatsTest, BlindStepsEqualAHistory) {
  AgentSession agent = NewAgent();
  AgentSession local = NewAgent();
  const ActionSpace& space = GetParam().action_space;
  const Action held = space.is_discrete() ? Action{.discrete = 1, .continuous = {}}
                                          : Action{.discrete = 0, .continuous = {0.5f, 0.25f}};
  std::vector<DoneBeat> done;
  for (int64_t t = 0; t < 6; ++t) {
    const bool sees = t < 2 || t == 5;
    done.push_back({sees ? ObservationAt(t) : std::vector<float>(), RewardAt(t), held});
    const auto told = t == 0 ? std::nullopt : std::optional<ReportedAction>(Reported(held, space));
    if (!sees) {
      ASSERT_TRUE(local.AddBlindStep(RewardAt(t), told).ok());
      continue;
    }
    ASSERT_EQ(local.next_step(), t);
    ASSERT_TRUE(local.Act(std::nullopt, ObservationAt(t), RewardAt(t), told).ok());
  }
  Apply(agent, done, 6, 6);
  ASSERT_TRUE(local.AddBlindStep(1.0, Reported(held, space)).ok());
  EXPECT_EQ(ExportSession(agent), ExportSession(local));
  // A step that is refused leaves the session as it was before the steps without an observation.
  const std::vector<float> too_short = {1.0f};
  EXPECT_FALSE(local.Act(std::nullopt, too_short, 1.0).ok());
  EXPECT_EQ(ExportSession(agent), ExportSession(local));
  EXPECT_EQ(local.next_step(), 7);
}

INSTANTIATE_TEST_SUITE_P(All, BeatsTest, ::testing::ValuesIn(BeatCases()),
                         [](const auto& instance) { return instance.param.name; });

TEST(SessionExportTest, ADamagedValueIsRefused) {
  FakeClock clock;
  const AgentSession agent(Serve(SmallConfig(), ActionSpace::Discrete(3)),
                           NewSession("id", SmallOptions()), &clock);
  const std::string value = ExportSession(agent);
  EXPECT_TRUE(ImportSession(value).ok());
  for (size_t i = 0; i < value.size(); i += 7) {
    std::string changed = value;
    changed[i] = static_cast<char>(changed[i] ^ 1);
    EXPECT_EQ(ImportSession(changed).status().code(), absl::StatusCode::kInvalidArgument) << i;
  }
  for (const size_t size : {size_t{0}, size_t{5}, value.size() - 1}) {
    EXPECT_FALSE(ImportSession(value.substr(0, size)).ok()) << size;
  }
}

}  // namespace
}  // namespace spikeserve
