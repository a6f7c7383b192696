#include "server/agent/policy_handler.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "tests/support/policy_handler_fixture.h"

namespace spikeserve {
namespace {

class PolicyHandlerTest : public PolicyHandlerFixture {
 protected:
  // Answers a batch in groups, as a call of ActBatch does.
  void ActBatch(const v1::ActBatchRequest& batch, v1::ActBatchResponse* answers,
                DeferredWork* deferred) {
    ASSERT_TRUE(PolicyHandler::CheckBatch(batch).ok());
    CallContext context{.caller = caller_.get(), .deferred = deferred};
    StepOutcome progress;
    for (int next = 0; next < batch.requests_size();) {
      next = handler_.ActBatchGroup(context, batch, next, answers, absl::ZeroDuration(), &progress);
    }
  }
};

TEST_F(PolicyHandlerTest, AnswersDoNotDependOnDeferredWork) {
  const std::string prompt = MustOpen();
  const std::string lazy = MustOpen();
  for (int64_t step = 0; step < 20; ++step) {
    v1::ActResponse expected;
    v1::ActResponse actual;
    DeferredWork done;
    DeferredWork dropped;
    ASSERT_TRUE(Decide(MakeRequest(prompt, step), &expected, &done).ok());
    done.Run();
    ASSERT_TRUE(Decide(MakeRequest(lazy, step), &actual, &dropped).ok());
    actual.set_session_id(prompt);
    EXPECT_EQ(actual.SerializeAsString(), expected.SerializeAsString()) << step;
  }
}

// The beats that one turn appends are bounded, whatever the number of sessions that have some.
TEST_F(PolicyHandlerTest, HistoriesOfManySessionsShareATurn) {
  constexpr int kSessions = 12;
  constexpr int64_t kBeats = 3 * kPastStepsPerGroup;
  DeferredWork deferred;
  v1::ActResponse answer;
  ASSERT_TRUE(Decide(MakeRequest(MustOpen(), 0), &answer, &deferred).ok());
  CallContext context{.caller = caller_.get(), .deferred = &deferred};
  std::vector<v1::ActRequest> requests;
  std::vector<v1::ActResponse> responses(kSessions);
  for (int i = 0; i < kSessions; ++i) {
    requests.push_back(MakeRequest(MustOpen(), 2 * kBeats));
    v1::ActRequest& request = requests.back();
    request.set_decision(2 * kBeats);
    for (int64_t step = 0; step < kBeats; ++step) request.add_skipped_rewards(1.0);
    for (int64_t step = kBeats; step < 2 * kBeats; ++step) {
      v1::Beat& beat = *request.add_history();
      beat.set_step(step);
      for (const float value : ObservationAt(step)) beat.add_observation(value);
      *beat.mutable_executed() = answer.action();
    }
  }
  std::vector<DecisionRequest> acts(kSessions);
  std::vector<DecisionRequest*> waiting;
  for (int i = 0; i < kSessions; ++i) {
    acts[i].context = &context;
    acts[i].request = &requests[i];
    acts[i].response = &responses[i];
    waiting.push_back(&acts[i]);
  }
  int64_t appended = 0;
  for (int turn = 1; !waiting.empty(); ++turn) {
    ASSERT_LE(turn, 2 * kSessions * 3 + kSessions);
    StepBudget budget;
    ASSERT_EQ(handler_.ActGroup(waiting, &deferred, &budget), waiting.size());
    int64_t sum = 0;
    for (const DecisionRequest& act : acts) sum += act.step.result.appended;
    EXPECT_LE(sum - appended, kPastStepsPerGroup) << turn;
    EXPECT_GT(sum, appended) << turn;
    appended = sum;
    std::erase_if(waiting, [](const DecisionRequest* act) { return act->is_decided(); });
  }
  EXPECT_EQ(appended, kSessions * kBeats);
  for (const DecisionRequest& act : acts) {
    EXPECT_TRUE(act.status.ok()) << act.status;
    EXPECT_EQ(act.step.result.dropped, kBeats);
  }
}

// The transitions of DecisionState up to the decision; lossy_store_test.cc has those to the answer.
TEST_F(PolicyHandlerTest, ARequestWaitsUntilItIsDecided) {
  const std::string session = MustOpen();
  v1::ActRequest requests[] = {MakeRequest(session, 2), MakeRequest(session, 3)};
  v1::ActResponse responses[2];
  DeferredWork deferred;
  CallContext contexts[2];
  DecisionRequest acts[2];
  std::vector<DecisionRequest*> both;
  for (int i = 0; i < 2; ++i) {
    contexts[i] = {.caller = caller_.get(), .deferred = &deferred, .may_claim = true};
    acts[i] = {.context = &contexts[i], .request = &requests[i], .response = &responses[i]};
    both.push_back(&acts[i]);
  }
  // Decides the first of both, because a group ends before the second request for its session.
  const auto decide = [&](StepBudget budget) {
    EXPECT_EQ(handler_.ActGroup(both, &deferred, &budget), 1);
  };
  requests[0].set_decision(2);
  for (int64_t step = 0; step < 2; ++step) {
    v1::Beat& beat = *requests[0].add_history();
    beat.set_step(step);
    for (const float value : ObservationAt(step)) beat.add_observation(value);
    beat.mutable_executed()->set_discrete(0);
  }
  EXPECT_EQ(acts[0].state, DecisionState::kArriving);
  // A part of the history is taken.
  decide({.steps = 1});
  EXPECT_EQ(acts[0].step.result.appended, 1);
  EXPECT_EQ(acts[0].state, DecisionState::kWaiting);
  // The session is not here, and is taken over.
  requests[0].set_session_id(std::string(32, '0'));
  requests[1].set_session_id(std::string(32, '0'));
  decide({});
  EXPECT_EQ(acts[0].state, DecisionState::kClaiming);
  acts[0].OnClaimed(absl::OkStatus());
  EXPECT_EQ(acts[0].state, DecisionState::kWaiting);
  // It is claimed once.
  decide({});
  EXPECT_EQ(acts[0].state, DecisionState::kDecided);
  EXPECT_TRUE(absl::IsNotFound(acts[0].status));
  // It is not taken over.
  both = {&acts[1]};
  decide({});
  EXPECT_EQ(acts[1].state, DecisionState::kClaiming);
  acts[1].OnClaimed(absl::UnavailableError("store"));
  EXPECT_EQ(acts[1].state, DecisionState::kDecided);
  EXPECT_TRUE(absl::IsUnavailable(acts[1].status));
  // The request is sent again, with the right session.
  requests[0].set_session_id(session);
  acts[0] = {.context = &contexts[0], .request = &requests[0], .response = &responses[0]};
  both = {&acts[0]};
  decide({});
  EXPECT_EQ(acts[0].state, DecisionState::kDecided);
  EXPECT_TRUE(acts[0].status.ok()) << acts[0].status;
  EXPECT_EQ(responses[0].step(), 2);
}

TEST_F(PolicyHandlerTest, DeferredWorkMayComeLate) {
  const std::string session = MustOpen();
  DeferredWork first;
  DeferredWork second;
  v1::ActResponse response;
  ASSERT_TRUE(Decide(MakeRequest(session, 0), &response, &first).ok());
  ASSERT_TRUE(Decide(MakeRequest(session, 1), &response, &second).ok());
  first.Run();
  v1::EndEpisodeRequest end;
  end.set_session_id(session);
  v1::EndEpisodeResponse ended;
  CallContext context{.caller = caller_.get()};
  ASSERT_TRUE(handler_.EndEpisode(context, end, &ended).ok());
  second.Run();
  response.Clear();
  EXPECT_TRUE(Decide(MakeRequest(session, 0), &response, &first).ok());
}

TEST_F(PolicyHandlerTest, ASessionWithWorkLeftIsNotReaped) {
  const std::string session = MustOpen();
  v1::ActResponse response;
  {
    DeferredWork deferred;
    ASSERT_TRUE(Decide(MakeRequest(session, 0), &response, &deferred).ok());
    clock_.Advance(absl::Hours(1));
    EXPECT_EQ(store_.RemoveIdle(absl::Minutes(1)), 0);
    deferred.Run();
  }
  EXPECT_EQ(store_.RemoveIdle(absl::Minutes(1)), 1);
}

// A batch of more sessions than are decided together, with several decisions per session. Those of
// the first half of the sessions follow each other directly; those of the others are interleaved.
TEST_F(PolicyHandlerTest, ABatchEqualsOneAfterTheOther) {
  constexpr int kSessions = 40;
  constexpr int64_t kSteps = 3;
  std::vector<std::string> alone;
  std::vector<std::string> batched;
  for (int i = 0; i < kSessions; ++i) {
    alone.push_back(MustOpen());
    batched.push_back(MustOpen());
  }
  for (int64_t first = 0; first < 6 * kSteps; first += kSteps) {
    std::vector<std::pair<int, int64_t>> order;  // session and step
    for (int i = 0; i < kSessions / 2; ++i) {
      for (int64_t step = 0; step < kSteps; ++step) order.emplace_back(i, first + step);
    }
    for (int64_t step = 0; step < kSteps; ++step) {
      for (int i = kSessions / 2; i < kSessions; ++i) order.emplace_back(i, first + step);
    }
    v1::ActBatchRequest batch;
    for (const auto& [i, step] : order) *batch.add_requests() = MakeRequest(batched[i], step);
    v1::ActBatchResponse answers;
    DeferredWork deferred;
    ActBatch(batch, &answers, &deferred);
    deferred.Run();
    ASSERT_EQ(answers.results_size(), static_cast<int>(order.size()));
    for (int k = 0; k < answers.results_size(); ++k) {
      const auto& [i, step] = order[k];
      v1::ActResponse expected;
      DeferredWork done;
      ASSERT_TRUE(Decide(MakeRequest(alone[i], step), &expected, &done).ok());
      done.Run();
      expected.set_session_id(batched[i]);
      EXPECT_EQ(answers.results(k).response().SerializeAsString(), expected.SerializeAsString())
          << "session " << i << " at step " << step;
    }
  }
}

// Each batch holds the locks of many sessions, and the two batches name them in opposite order.
// They must not deadlock.
TEST_F(PolicyHandlerTest, BatchesOfTheSameSessionsDoNotWaitForEachOther) {
  v1::ActBatchRequest forward;
  v1::ActBatchRequest backward;
  std::vector<std::string> sessions;
  for (int i = 0; i < 16; ++i) sessions.push_back(MustOpen());
  for (size_t i = 0; i < sessions.size(); ++i) {
    *forward.add_requests() = MakeRequest(sessions[i], 0);
    *backward.add_requests() = MakeRequest(sessions[sessions.size() - 1 - i], 0);
  }
  const auto keep_asking = [&](const v1::ActBatchRequest& batch) {
    for (int i = 0; i < 2000; ++i) {
      v1::ActBatchResponse answers;
      DeferredWork deferred;
      ActBatch(batch, &answers, &deferred);
      deferred.Run();
      for (const v1::ActResult& result : answers.results()) ASSERT_TRUE(result.has_response());
    }
  };
  std::thread other([&] { keep_asking(backward); });
  keep_asking(forward);
  other.join();
}

}  // namespace
}  // namespace spikeserve
