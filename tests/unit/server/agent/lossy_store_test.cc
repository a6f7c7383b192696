// Simulates a robot, with its end of a session, and a server that dies again and again before its
// store has what it has acknowledged. Everything is driven by one random number generator.
#include <gtest/gtest.h>

#include <algorithm>
#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "client/src/pilot/robot_messages.h"
#include "core/journal/journal_entry.h"
#include "core/journal/session_export.h"
#include "core/robot/robot_session.h"
#include "server/base/expected_decision.h"
#include "server/services/act_queue.h"
#include "tests/support/policy_handler_fixture.h"

namespace spikeserve {
namespace {

using Kind = JournalRecord::Kind;
using robot::RobotSession;
using robot::Task;

constexpr robot::Time kPeriod = std::chrono::milliseconds(20);

// A store that is behind its server: what waits is lost when the server dies.
class LateWriter final : public JournalWriter {
 public:
  void Write(JournalRecord record) override { waiting_.push_back(std::move(record)); }
  void Hurry() override {}
  absl::Status CheckReachable() const override { return absl::OkStatus(); }
  absl::Status CheckBacklog() const override { return absl::OkStatus(); }

  // Stores what waits, at most `count` records.
  void Store(size_t count) {
    for (; count > 0 && !waiting_.empty(); --count) {
      const JournalRecord record = std::move(waiting_.front());
      waiting_.pop_front();
      if (record.kind != Kind::kEntry) stored_.clear();
      stored_.push_back(record.bytes);
      record.journal->OnWritten(record, absl::OkStatus());
    }
  }

  std::deque<JournalRecord> waiting_;
  std::vector<std::string> stored_;
};

// One life of a server.
struct Life {
  Life(PolicyRegistry* registry, ShadowRunner* shadows, const Clock* clock, JournalWriter* writer)
      : store(100, clock),
        gate(&store),
        handler(registry, &gate, shadows, clock, nullptr, {.journals = writer}) {}

  SessionStore store;
  SessionGate gate;
  PolicyHandler handler;
};

struct DoneBeat {
  std::vector<float> observation;
  double reward;
  int64_t executed;
};

// Notes its answer.
class NotedAct final : public QueuedAct {
 public:
  using QueuedAct::QueuedAct;
  std::optional<absl::Status> answer;

 private:
  void Send(const absl::Status& status) override { answer = status; }
};

class LossyStoreTest : public PolicyHandlerFixture {
 protected:
  void Open(size_t kept, uint64_t seed, v1::Durability durability = v1::ASYNC) {
    random_.seed(seed);
    life_ = std::make_unique<Life>(registry_.get(), &shadows_, &clock_, &writer_);
    v1::OpenSessionRequest request;
    request.set_policy("small");
    request.set_durability(durability);
    request.set_action_selection(v1::SAMPLE);
    request.mutable_learning()->set_learning_rate(0.1);
    v1::OpenSessionResponse opened;
    CallContext context{.caller = caller_.get()};
    ASSERT_TRUE(life_->handler.OpenSession(context, request, &opened).ok());
    id_ = opened.session_id();
    robot_ = std::make_unique<RobotSession>(robot::Settings{.observation_size = kObservationSize,
                                                            .period = kPeriod,
                                                            .oldest = std::chrono::seconds(1),
                                                            .oldest_held = std::chrono::seconds(1),
                                                            .hold_steps = 2,
                                                            .most_in_flight = 8,
                                                            .kept_steps = kept},
                                            piloting::ShapeOf(opened.action_space()),
                                            piloting::OpeningOf(opened), Now());
    writer_.Store(1);
    const auto entry = life_->store.Peek(id_);
    const absl::MutexLock lock(&entry->mutex);
    served_ = entry->served;
    steady_ = std::make_unique<AgentSession>(served_, entry->agent.session(), &clock_);
  }

  size_t Draw(size_t below) { return random_() % below; }

  robot::Now Now() const { return {now_, now_}; }

  // A control step. Sometimes a safety layer has replaced the action before.
  void Beat() {
    now_ += kPeriod;
    const auto t = static_cast<int64_t>(beats_++);
    std::vector<DoneBeat>& episode = episodes_.back();
    const robot::ActionView replaced = {.discrete = static_cast<int64_t>(Draw(2))};
    const bool is_replaced = !episode.empty() && Draw(4) == 0;
    if (is_replaced) episode.back().executed = replaced.discrete;
    const std::vector<float> observation = ObservationAt(t);
    const double reward = 0.25 * static_cast<double>(t % 5);
    ASSERT_TRUE(robot_->BeginStep({.observation = observation,
                                   .reward = reward,
                                   .executed = is_replaced ? &replaced : nullptr},
                                  Now()));
    if (robot_->Choose(Now(), now_) == robot::Choice::kOwnAction) robot_->TakeOwn(&replaced);
    episode.push_back({observation, reward, robot_->FinishStep(Now()).action.discrete});
  }

  void End() {
    if (!robot_->EndEpisode({.reward = 1.0, .terminated = true}, nullptr).has_value()) return;
    episodes_.emplace_back();
  }

  // Does what the robot's end of the session wants, up to its next request.
  void Send() {
    now_ += std::chrono::milliseconds(1);
    while (true) {
      const Task task = robot_->Next(now_);
      if (task.kind == Task::Kind::kSend) {
        v1::ActRequest request;
        piloting::ToProto(robot_->step_log(), task.request, &request);
        request.set_session_id(id_);
        wire_.push_back(std::move(request));
        return;
      }
      if (task.kind == Task::Kind::kWait) return;
      ASSERT_NE(task.kind, Task::Kind::kForget) << task.reason;
      if (task.kind == Task::Kind::kOpenStream) robot_->OnStreamOpened(0);
      if (task.kind == Task::Kind::kCloseStream) robot_->OnStreamClosed(false, now_);
    }
  }

  absl::Status Serve(const v1::ActRequest& request, v1::ActResponse* response) {
    DeferredWork deferred;
    CallContext context{.caller = caller_.get(), .deferred = &deferred};
    const absl::Status status = life_->handler.Act(context, request, response);
    deferred.Run();
    return status;
  }

  // The server answers the next request.
  void Deliver() {
    if (wire_.empty()) return;
    const v1::ActRequest request = std::move(wire_.front());
    wire_.pop_front();
    v1::ActResponse response;
    const absl::Status status = Serve(request, &response);
    if (absl::IsUnavailable(status)) return Cut();  // too much waits for the store
    robot::Error error;
    robot::Reply reply = piloting::ReplyOf(response, &error);
    if (!status.ok()) {
      const auto expected = ExpectedDecisionOf(status);
      ASSERT_TRUE(expected.has_value()) << status;
      error = {.message = status.ToString(),
               .expected_decision = expected->decision,
               .expected_episode = expected->episode};
      reply.error = &error;
    }
    const auto settled = robot_->OnReply(reply, Now()).settled;
    if (settled.has_value()) summaries_.emplace(settled->serial, *settled);
  }

  // What was under way when the link was cut arrives after all, when nobody waits for its answer.
  void DeliverLate() {
    for (const v1::ActRequest& request : std::exchange(late_, {})) {
      v1::ActResponse reply;
      const absl::Status status = Serve(request, &reply);
      EXPECT_TRUE(status.ok() || absl::IsUnavailable(status) ||
                  ExpectedDecisionOf(status).has_value())
          << status;
    }
  }

  void Cut() {
    late_ = std::exchange(wire_, {});
    robot_->OnStreamEnded({.text = "cut"});
  }

  // Loses all that waits, or the last few records.
  void Kill() {
    Cut();
    const size_t waiting = writer_.waiting_.size();
    if (Draw(2) == 0) writer_.Store(waiting - std::min(waiting, Draw(4)));
    writer_.waiting_.clear();
    life_ = std::make_unique<Life>(registry_.get(), &shadows_, &clock_, &writer_);
    auto session = RestoreSession(*ParseJournal(writer_.stored_), served_->policy());
    ASSERT_TRUE(session.ok()) << session.status();
    SessionExtras extras;
    extras.id = id_;
    extras.journal = std::make_shared<SessionJournal>(
        SessionJournal::Key{.id = id_, .tenant = "", .epoch = ++epoch_, .ended = session->episode},
        Durability::kAsync, session->decisions, &writer_, writer_.stored_.size());
    ASSERT_TRUE(life_->store.Restore(served_, *std::move(session), std::move(extras)).ok());
  }

  void MakeFault() {
    switch (Draw(4)) {
      case 0:
        return Cut();
      case 1:
        return DeliverLate();
      default:
        return Kill();
    }
  }

  void Fly(int faults) {
    while (faults > 0) {
      switch (const size_t event = Draw(64); event) {
        case 0:
          End();
          break;
        case 1:
          MakeFault();
          --faults;
          break;
        default:
          event < 20 ? Beat() : event < 36 ? Send() : event < 56 ? Deliver() : writer_.Store(1);
      }
      if (HasFatalFailure()) return;
    }
    Beat();
    End();
    for (int i = 0; i < 100'000 && robot_->step_log().oldest().has_ended(); ++i) {
      Send();
      Deliver();
      writer_.Store(1);
      if (HasFatalFailure()) return;
    }
    ASSERT_FALSE(robot_->step_log().oldest().has_ended()) << "the server never got all episodes";
  }

  void CheckSummaries() {
    EXPECT_EQ(robot_->counters().counts().unequal_returns, 0);
    EXPECT_EQ(summaries_.size(), episodes_.size() - 1);
    for (const auto& [serial, summary] : summaries_) {
      const std::vector<DoneBeat>& episode = episodes_[serial];
      double rewards = 1.0;
      for (size_t t = 1; t < episode.size(); ++t) rewards += episode[t].reward;
      EXPECT_EQ(summary.episode_return, rewards);
      EXPECT_EQ(summary.steps, episode.size());
    }
  }

  // Plays the same without a server, and compares the values.
  void CheckValue() {
    for (const auto& episode : episodes_) {
      if (episode.empty()) break;
      std::optional<ReportedAction> executed;
      for (size_t t = 0; t < episode.size(); ++t) {
        ASSERT_TRUE(
            steady_
                ->Act(static_cast<int64_t>(t), episode[t].observation, episode[t].reward, executed)
                .ok());
        executed = episode[t].executed;
      }
      EpisodeEnd end = {.reward = 1.0, .terminated = true};
      end.executed_action =
          Action{.discrete = static_cast<int>(episode.back().executed), .continuous = {}};
      ASSERT_TRUE(steady_->EndEpisode(end).ok());
    }
    const auto entry = life_->store.Peek(id_);
    const absl::MutexLock lock(&entry->mutex);
    EXPECT_TRUE(ExportSession(entry->agent) == ExportSession(*steady_)) << "the values differ";
  }

  std::mt19937_64 random_;
  LateWriter writer_;
  std::unique_ptr<Life> life_;
  std::unique_ptr<RobotSession> robot_;
  robot::Time now_ = robot::Time::zero();
  std::unique_ptr<AgentSession> steady_;
  std::shared_ptr<const ServedPolicy> served_;
  std::string id_;
  uint64_t epoch_ = 1;
  size_t beats_ = 0;
  std::vector<std::vector<DoneBeat>> episodes_{1};
  std::map<uint64_t, robot::Settled> summaries_;  // by serial number of the episode
  std::deque<v1::ActRequest> wire_;
  std::deque<v1::ActRequest> late_;
};

class LossyStoreSeedTest : public LossyStoreTest, public ::testing::WithParamInterface<int> {};

TEST_P(LossyStoreSeedTest, NothingIsLostOrDoubled) {
  Open(/*kept=*/10'000, static_cast<uint64_t>(GetParam()));
  Fly(/*faults=*/50);
  if (HasFatalFailure()) return;
  CheckSummaries();
  CheckValue();
}

// The context may have gaps then, and the rewards are all there.
TEST_P(LossyStoreSeedTest, OfBeatsThatAreNotKeptTheRewardsCount) {
  Open(/*kept=*/2 + static_cast<size_t>(GetParam()), static_cast<uint64_t>(GetParam()));
  Fly(/*faults=*/50);
  if (!HasFatalFailure()) CheckSummaries();
}

INSTANTIATE_TEST_SUITE_P(Seeds, LossyStoreSeedTest, ::testing::Range(0, 10));

// The transitions of DecisionState to the answer; policy_handler_test.cc has those before.
TEST_F(LossyStoreTest, ARequestIsAnsweredWhenItIsRefusedOrTheStoreHasIt) {
  ASSERT_NO_FATAL_FAILURE(Open(/*kept=*/8, /*seed=*/1, v1::SYNC));
  const TransportLimits limits;
  TransportBudgets budgets;
  const auto loop = *TransportLoop::Create(&limits, &budgets, &clock_);
  ActQueue queue(&life_->handler, loop.get());
  queue.SetQueues({&queue});
  const ServiceContext context = {.gate = nullptr,
                                  .authenticator = nullptr,
                                  .metrics = nullptr,
                                  .clock = &clock_,
                                  .max_message_bytes = 0,
                                  .sessions = &life_->gate};
  const auto refused = std::make_shared<NotedAct>(&context, &queue);
  EXPECT_EQ(refused->act().state, DecisionState::kArriving);
  refused->Answer(absl::ResourceExhaustedError("bytes"));
  EXPECT_EQ(refused->act().state, DecisionState::kAnswered);
  EXPECT_TRUE(absl::IsResourceExhausted(*refused->answer));

  // The second request waits behind the first one, whose history takes two turns.
  constexpr int64_t kBeats = kPastStepsPerGroup + 1;
  const std::shared_ptr<NotedAct> acts[] = {std::make_shared<NotedAct>(&context, &queue),
                                            std::make_shared<NotedAct>(&context, &queue)};
  for (int64_t i = 0; i < 2; ++i) {
    v1::ActRequest& request = *acts[i]->request();
    request = MakeRequest(id_, kBeats + i);
    request.set_decision(static_cast<uint64_t>(kBeats + i));
  }
  for (int64_t step = 0; step < kBeats; ++step) {
    v1::Beat& beat = *acts[0]->request()->add_history();
    beat.set_step(step);
    for (const float value : ObservationAt(step)) beat.add_observation(value);
    beat.mutable_executed()->set_discrete(0);
  }
  for (const auto& act : acts) act->Enter(caller_.get());
  for (const auto decided : {0, 1, 2}) {
    queue.Run();
    for (int i = 0; i < 2; ++i) {
      EXPECT_EQ(acts[i]->act().state,
                i < decided ? DecisionState::kDecided : DecisionState::kWaiting);
      EXPECT_FALSE(acts[i]->answer.has_value());
    }
  }
  writer_.Store(writer_.waiting_.size());
  loop->events().Post([&] { loop->events().Stop(); });
  loop->events().Run();
  for (const auto& act : acts) {
    EXPECT_EQ(act->act().state, DecisionState::kAnswered);
    ASSERT_TRUE(act->answer.has_value());
    EXPECT_TRUE(act->answer->ok()) << *act->answer;
    EXPECT_EQ(act->response()->durable_decision(), act->response()->step() + 1);
  }
}

}  // namespace
}  // namespace spikeserve
