#include "server/store/journal_store.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <prometheus/text_serializer.h>

#include <optional>

#include "absl/synchronization/notification.h"
#include "core/journal/session_journal.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

constexpr absl::Duration kDeadline = absl::Seconds(30);

// A backend that can be made unreachable.
class FakeBackend final : public JournalBackend {
 public:
  absl::StatusOr<std::vector<absl::Status>> Write(
      absl::Span<const JournalRecord> records) override {
    absl::MutexLock lock(&mutex_);
    ++tries_;
    if (!status_.ok()) return status_;
    std::vector<absl::Status> outcomes;
    for (const JournalRecord& record : records) {
      const bool is_refused = record.journal->key().id == refused_;
      outcomes.push_back(is_refused ? absl::UnavailableError("moving") : absl::OkStatus());
      if (!is_refused) written_.push_back(record.bytes);
    }
    return outcomes;
  }

  std::vector<absl::StatusOr<ClaimedJournal>> Claim(
      absl::Span<const JournalClaim> claims) override {
    absl::MutexLock lock(&mutex_);
    if (!status_.ok()) return {claims.size(), status_};
    std::vector<absl::StatusOr<ClaimedJournal>> claimed(claims.size());
    for (size_t i = 0; i < claims.size(); ++i) {
      if (claims[i].id == "known") {
        claimed[i] = ClaimedJournal{.epoch = 2, .records = written_};
      } else {
        claimed[i] = absl::NotFoundError("unknown");
      }
    }
    return claimed;
  }

  void SetStatus(const absl::Status& status) {
    absl::MutexLock lock(&mutex_);
    status_ = status;
  }
  // Refuses the records of a session.
  void Refuse(const std::string& id) {
    absl::MutexLock lock(&mutex_);
    refused_ = id;
  }
  // Waits until Write() has been called `tries` times.
  void AwaitTries(int tries) {
    absl::MutexLock lock(&mutex_);
    const auto reached = [&]() ABSL_SHARED_LOCKS_REQUIRED(mutex_) { return tries_ >= tries; };
    ASSERT_TRUE(mutex_.AwaitWithTimeout(absl::Condition(&reached), kDeadline));
  }
  std::vector<std::string> written() {
    absl::MutexLock lock(&mutex_);
    return written_;
  }

 private:
  absl::Mutex mutex_;
  absl::Status status_ ABSL_GUARDED_BY(mutex_);
  std::string refused_ ABSL_GUARDED_BY(mutex_);
  int tries_ ABSL_GUARDED_BY(mutex_) = 0;
  std::vector<std::string> written_ ABSL_GUARDED_BY(mutex_);
};

class JournalStoreTest : public ::testing::Test {
 protected:
  JournalStoreTest() {
    auto backend = std::make_unique<FakeBackend>();
    backend_ = backend.get();
    store_ = std::make_unique<JournalStore>(std::move(backend), &clock_, &registry_);
    journal_ = std::make_shared<SessionJournal>(SessionJournal::Key{.id = "id", .tenant = ""},
                                                Durability::kSync, /*decisions=*/0, store_.get());
  }

  void Write(const std::string& bytes, uint64_t position,
             std::shared_ptr<SessionJournal> journal = nullptr) {
    if (journal == nullptr) journal = journal_;
    store_->Write({.bytes = bytes,
                   .decisions = position,
                   .position = position,
                   .journal = std::move(journal)});
  }

  std::shared_ptr<SessionJournal> Other() {
    return std::make_shared<SessionJournal>(SessionJournal::Key{.id = "other", .tenant = ""},
                                            Durability::kSync, /*decisions=*/0, store_.get());
  }

  // Waits for the outcome of a position.
  absl::Status Outcome(uint64_t position) { return Outcome(position, *journal_); }
  static absl::Status Outcome(uint64_t position, SessionJournal& journal) {
    absl::Notification done;
    absl::Status outcome;
    journal.WhenDurable(position, [&](const absl::Status& status) {
      outcome = status;
      done.Notify();
    });
    EXPECT_TRUE(done.WaitForNotificationWithTimeout(kDeadline));
    return outcome;
  }

  absl::StatusOr<ClaimedJournal> Claim(const std::string& id) {
    absl::Notification done;
    absl::StatusOr<ClaimedJournal> claimed;
    store_->Claim({.id = id, .tenant = ""}, [&](absl::StatusOr<ClaimedJournal> result) {
      claimed = std::move(result);
      done.Notify();
    });
    EXPECT_TRUE(done.WaitForNotificationWithTimeout(kDeadline));
    return claimed;
  }

  std::string Metrics() { return prometheus::TextSerializer().Serialize(registry_.Collect()); }

  SteadyClock clock_;
  prometheus::Registry registry_;
  FakeBackend* backend_;
  std::unique_ptr<JournalStore> store_;
  std::shared_ptr<SessionJournal> journal_;
};

TEST_F(JournalStoreTest, RecordsAreWrittenInOrderAndAcknowledged) {
  for (uint64_t i = 1; i <= 3; ++i) Write(std::string(1, static_cast<char>('a' + i)), i);
  EXPECT_TRUE(Outcome(3).ok());
  EXPECT_THAT(backend_->written(), ElementsAre("b", "c", "d"));
  EXPECT_EQ(journal_->durable_decisions(), 3u);
  EXPECT_THAT(Metrics(), HasSubstr("spikeserve_store_records_total{outcome=\"written\"} 3"));
}

TEST_F(JournalStoreTest, RecordsThatNoAnswerWaitsForAreWrittenToo) {
  Write("a", 1);
  backend_->AwaitTries(1);
  EXPECT_THAT(backend_->written(), ElementsAre("a"));
}

TEST_F(JournalStoreTest, AClaimSeesWhatWasWrittenBefore) {
  Write("a", 1);
  const auto claimed = Claim("known");
  ASSERT_TRUE(claimed.ok()) << claimed.status();
  EXPECT_THAT(claimed->records, ElementsAre("a"));
  EXPECT_EQ(Claim("unknown").status().code(), absl::StatusCode::kNotFound);
}

TEST_F(JournalStoreTest, ASessionWhoseRecordsAreRefusedHoldsNoOther) {
  const auto other = Other();
  backend_->Refuse("other");
  Write("x", 1, other);
  EXPECT_EQ(Outcome(1, *other).code(), absl::StatusCode::kUnavailable);
  Write("y", 2, other);
  for (uint64_t i = 1; i <= 20; ++i) {
    Write("a", i);
    EXPECT_TRUE(Outcome(i).ok());
  }
  EXPECT_TRUE(store_->CheckReachable().ok());
  EXPECT_EQ(Claim("known")->records.size(), 20u);
  EXPECT_THAT(Metrics(), HasSubstr("spikeserve_store_reachable 0"));
  backend_->Refuse("");
  const absl::Duration end = clock_.Now() + kDeadline;
  while (other->durable_decisions() < 2 && clock_.Now() < end) std::this_thread::yield();
  const auto written = backend_->written();
  ASSERT_EQ(written.size(), 22u);
  EXPECT_EQ(written[20], "x");
  EXPECT_EQ(written[21], "y");
}

TEST_F(JournalStoreTest, StoppingTriesWhatWasRefusedAgain) {
  const auto other = Other();
  backend_->Refuse("other");
  Write("x", 1, other);
  EXPECT_EQ(Outcome(1, *other).code(), absl::StatusCode::kUnavailable);
  backend_->Refuse("");
  store_->Stop(kDeadline);
  EXPECT_THAT(backend_->written(), ElementsAre("x"));
}

TEST_F(JournalStoreTest, StoppingGivesUpWhatIsRefused) {
  const auto other = Other();
  backend_->Refuse("other");
  Write("x", 1, other);
  EXPECT_EQ(Outcome(1, *other).code(), absl::StatusCode::kUnavailable);
  store_->Stop(absl::Milliseconds(10));
  EXPECT_THAT(backend_->written(), IsEmpty());
}

TEST_F(JournalStoreTest, TheBacklogIsBounded) {
  backend_->SetStatus(absl::UnavailableError("down"));
  uint64_t position = 0;
  const std::string large(1 << 20, 'x');
  for (; store_->CheckBacklog().ok() && position < 1000; ++position) Write(large, position + 1);
  EXPECT_EQ(position, 64u);
  EXPECT_EQ(store_->CheckBacklog().code(), absl::StatusCode::kUnavailable);
}

TEST_F(JournalStoreTest, StoppingWritesWhatWaits) {
  Write("a", 1);
  store_->Stop(kDeadline);
  EXPECT_THAT(backend_->written(), ElementsAre("a"));
}

TEST_F(JournalStoreTest, StoppingGivesUpAStoreThatIsAway) {
  backend_->SetStatus(absl::UnavailableError("down"));
  Write("a", 1);
  store_->Stop(absl::ZeroDuration());
  EXPECT_THAT(backend_->written(), IsEmpty());
}

}  // namespace
}  // namespace spikeserve
