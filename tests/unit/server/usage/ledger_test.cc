// The ledger keeps what the store does not take, in bounded memory.
#include "server/usage/ledger.h"

#include <memory>
#include <vector>

#include "gtest/gtest.h"
#include "server/access/authenticator.h"
#include "tests/support/fake_clock.h"

namespace spikeserve {
namespace {

// Remembers batches while it is there.
class AwayStore final : public UsageStore {
 public:
  absl::Status Book(const UsageBatch& batch) override {
    if (is_away) return absl::UnavailableError("away");
    batches.push_back(batch);
    return absl::OkStatus();
  }
  absl::StatusOr<std::map<std::string, UsageCounts>> MonthOf(absl::Time) override {
    return absl::UnavailableError("not asked");
  }
  absl::StatusOr<std::vector<std::string>> Parts() override { return std::vector<std::string>(); }
  absl::StatusOr<UsagePart> Read(const std::string&) override { return UsagePart(); }
  absl::Status Replace(const UsagePart&, const UsagePart&, const std::string&) override {
    return absl::OkStatus();
  }
  absl::Status Forget(absl::Duration) override { return absl::OkStatus(); }

  bool is_away = true;
  std::vector<UsageBatch> batches = {};
};

TEST(Ledger, KeepsOneBatchForAnHourInWhichTheStoreIsAway) {
  const FakeClock clock;
  SessionStore sessions(/*max_sessions=*/1, &clock);
  const auto authenticator = Authenticator::Create("");
  ASSERT_TRUE(authenticator.ok());
  const auto store = std::make_shared<AwayStore>();
  absl::Time now = absl::FromCivil(absl::CivilHour(2026, 1, 1, 8), absl::UTCTimeZone());
  Ledger ledger({.process = "process", .label = "", .now = [&now] { return now; }}, store, store,
                /*find_ownerless=*/nullptr, &sessions, authenticator->get(), &clock);
  for (int minute = 0; minute < 90; ++minute) {
    (*authenticator)->Tenants().front()->CountReceived(1);
    EXPECT_FALSE(ledger.BookAll());
    now += absl::Minutes(1);
  }
  store->is_away = false;
  EXPECT_TRUE(ledger.BookAll());
  // The first one was sent, and may have arrived.
  std::vector<double> bytes;
  for (const UsageBatch& batch : store->batches) {
    bytes.push_back(batch.added.begin()->second[UsageField::kBytes]);
  }
  EXPECT_EQ(bytes, (std::vector<double>{1, 59, 30}));
}

}  // namespace
}  // namespace spikeserve
