// Simulates a robot, with the log of the C++ pilot, and a server that dies again and again before
// its store has what it has acknowledged. Everything is driven by one random number generator.
#include <gtest/gtest.h>

#include <algorithm>
#include <deque>
#include <future>
#include <memory>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "client/src/pilot/beat_log.h"
#include "core/journal/journal_entry.h"
#include "core/journal/session_export.h"
#include "server/base/expected_decision.h"
#include "tests/support/policy_handler_fixture.h"

namespace spikeserve {
namespace {

using Kind = JournalRecord::Kind;
using piloting::BeatLog;

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

struct Sent {
  v1::ActRequest request;
  int64_t episode;
};

class LossyStoreTest : public PolicyHandlerFixture {
 protected:
  void Open(size_t kept, uint64_t seed) {
    random_.seed(seed);
    v1::ActionSpace space;
    space.mutable_discrete()->set_n(2);
    log_ = std::make_unique<BeatLog>(kept, kObservationSize, piloting::ActionShape(space));
    life_ = std::make_unique<Life>(registry_.get(), &shadows_, &clock_, &writer_);
    v1::OpenSessionRequest request;
    request.set_policy("small");
    request.set_durability(v1::ASYNC);
    request.set_action_selection(v1::SAMPLE);
    request.mutable_learning()->set_learning_rate(0.1);
    v1::OpenSessionResponse opened;
    CallContext context{.caller = caller_.get()};
    ASSERT_TRUE(life_->handler.OpenSession(context, request, &opened).ok());
    id_ = opened.session_id();
    log_->set_history_limit(opened.history_limit());
    writer_.Store(1);
    const auto entry = life_->store.Peek(id_);
    const absl::MutexLock lock(&entry->mutex);
    served_ = entry->served;
    steady_ = std::make_unique<AgentSession>(served_, entry->agent.session(), &clock_);
  }

  size_t Draw(size_t below) { return random_() % below; }

  void Beat() {
    const auto t = static_cast<int64_t>(beats_++);
    episodes_.back().push_back(
        {ObservationAt(t), 0.25 * static_cast<double>(t % 5), static_cast<int64_t>(Draw(2))});
    const DoneBeat& beat = episodes_.back().back();
    log_->Add(beat.observation, beat.reward, t);
    log_->SetExecuted({.discrete = beat.executed, .continuous = {}});
  }

  void End() {
    if (episodes_.back().empty()) return;
    summaries_.push_back(log_->End({.reward = 1.0, .terminated = true}));
    episodes_.emplace_back();
  }

  // As Link::SendRequest.
  void Send() {
    const bool is_end = !log_->is_current();
    if (is_end ? !log_->oldest().ending.has_value() || log_->is_ending()
               : log_->running().steps == 0) {
      return;
    }
    Sent sent = {.request = {}, .episode = log_->asked().index};
    log_->FillRequest(&sent.request);
    sent.request.set_session_id(id_);
    if (is_end && log_->FitsOne()) {
      log_->FillEnd(sent.request.mutable_end_episode());
      log_->BeginEnd();
    }
    wire_.push_back(std::move(sent));
  }

  absl::Status Serve(const v1::ActRequest& request, v1::ActResponse* response) {
    DeferredWork deferred;
    CallContext context{.caller = caller_.get(), .deferred = &deferred};
    const absl::Status status = life_->handler.Act(context, request, response);
    deferred.Run();
    return status;
  }

  // The server answers the next request. As Link::OnReply.
  void Deliver() {
    if (wire_.empty()) return;
    const Sent sent = std::move(wire_.front());
    wire_.pop_front();
    v1::ActResponse reply;
    const absl::Status status = Serve(sent.request, &reply);
    if (absl::IsUnavailable(status)) return Cut();  // too much waits for the store
    const bool is_oldest = sent.episode == log_->oldest().index;
    if (status.ok() && is_oldest) {
      log_->ForgetDurable(reply.durable_decision(), reply.durable_episode());
      if (!sent.request.has_end_episode()) return log_->Acknowledge(reply.next_step());
      log_->Settle(/*is_stored=*/true).summary.set_value(reply.ended());
    } else if (!status.ok()) {
      const auto expected = ExpectedDecisionOf(status);
      ASSERT_TRUE(expected.has_value()) << status;
      if (!is_oldest) return;
      if (sent.request.has_end_episode()) log_->AbandonEnd();
      ASSERT_TRUE(log_->Rewind(expected->decision, expected->episode)) << status;
    }
  }

  // What was under way when the link was cut arrives after all, when nobody waits for its answer.
  void DeliverLate() {
    for (const Sent& sent : std::exchange(late_, {})) {
      v1::ActResponse reply;
      const absl::Status status = Serve(sent.request, &reply);
      EXPECT_TRUE(status.ok() || absl::IsUnavailable(status) ||
                  ExpectedDecisionOf(status).has_value())
          << status;
    }
  }

  void Cut() {
    late_ = std::exchange(wire_, {});
    log_->AbandonEnd();
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
    for (int i = 0; i < 100'000 && log_->oldest().ending.has_value(); ++i) {
      Send();
      Deliver();
      writer_.Store(1);
      if (HasFatalFailure()) return;
    }
    ASSERT_FALSE(log_->oldest().ending.has_value()) << "the server never got all episodes";
  }

  void CheckSummaries() {
    for (size_t i = 0; i < summaries_.size(); ++i) {
      const auto summary = summaries_[i].get();
      ASSERT_TRUE(summary.ok()) << summary.status();
      double rewards = 1.0;
      for (size_t t = 1; t < episodes_[i].size(); ++t) rewards += episodes_[i][t].reward;
      EXPECT_EQ(summary->episode_return(), rewards);
      EXPECT_EQ(summary->steps(), static_cast<int64_t>(episodes_[i].size()));
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
  std::unique_ptr<BeatLog> log_;
  std::unique_ptr<AgentSession> steady_;
  std::shared_ptr<const ServedPolicy> served_;
  std::string id_;
  uint64_t epoch_ = 1;
  size_t beats_ = 0;
  std::vector<std::vector<DoneBeat>> episodes_{1};
  std::vector<std::future<absl::StatusOr<v1::EndEpisodeResponse>>> summaries_;
  std::deque<Sent> wire_;
  std::deque<Sent> late_;
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

}  // namespace
}  // namespace spikeserve
