// The ledger is small, rounds little, and is compacted without losing anything.
#include "server/usage/usage_store.h"

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <map>
#include <random>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "gtest/gtest.h"
#include "server/usage/usage_rows.h"
#include "tests/support/fake_clock.h"

namespace spikeserve {
namespace {

std::string Series(int tenant, int policy) {
  return UsageSeries{.tenant = absl::StrCat("tenant-", tenant),
                     .policy = absl::StrCat("policy-", policy),
                     .version = 1 + policy % 3}
      .ToKey();
}

absl::Time Day(int month, int day, int hour = 0) {
  return absl::FromCivil(absl::CivilHour(2026, month, day, hour), absl::UTCTimeZone());
}

UsageBatch Batch(uint64_t number, absl::Time time) {
  UsageBatch batch = {.source = "process", .number = number, .time = time};
  UsageCounts counts;
  counts[UsageField::kDecisions] = 3;
  counts[UsageField::kSpikes] = 1000;
  counts[UsageField::kHorowitz45nm] = 2e-6;
  batch.added[Series(1, 1)] = counts;
  return batch;
}

UsageCounts SumOf(const std::vector<UsageRow>& rows) {
  UsageCounts sum;
  for (const UsageRow& row : rows) sum += row.counts;
  return sum;
}

// What robots at 10 Hz use in an hour with a policy in integers, each hour a little else.
UsageCounts Hour(std::mt19937* random) {
  std::normal_distribution<double> noise;
  const auto about = [&](double mean, double part) { return mean * (1 + part * noise(*random)); };
  UsageCounts counts;
  counts[UsageField::kDecisions] = std::round(about(36'000, 3e-4));
  const double activity = about(1.0, 0.01);
  counts[UsageField::kSpikes] = std::round(9e6 * activity);
  counts[UsageField::kHorowitz45nm] = about(0.07, 1e-3) * activity;
  counts[UsageField::kInt45nm] = about(0.02, 1e-3) * activity;
  counts[UsageField::kIntSram45nm] = about(0.3, 1e-3) * activity;
  counts[UsageField::kSessionSeconds] = about(3600.0, 1e-6);
  return counts;
}

TEST(UsageRows, ADayOfAThousandTenantsWithTenPoliciesIsBelowItsPartOf50Megabytes) {
  std::mt19937 random(1);
  UsageRows rows;
  for (int series = 0; series < 10'000; ++series) {
    for (int hour = 0; hour < 24; ++hour) {
      rows[{Series(series / 10, series % 10), hour}] = Hour(&random);
    }
  }
  EXPECT_LT(PackRows(rows).size(), 50'000'000 / 31);
}

// Sums lose nothing, and rows little.
TEST(UsageRows, ReturnsWhatWasPacked) {
  std::mt19937 random(2);
  UsageRows rows;
  for (int i = 0; i < 100; ++i) rows[{Series(i % 7, 1), 490'000 + i}] = Hour(&random);
  UsageCounts all;
  for (size_t i = 0; i < kUsageFields; ++i) all.values[i] = static_cast<double>(i);
  rows[{UsageSeries{.tenant = "", .label = "robot \"1\""}.ToKey(), -5}] = all;
  const auto unpacked = UnpackRows(PackRows(rows));
  ASSERT_TRUE(unpacked.ok()) << unpacked.status();
  ASSERT_EQ(unpacked->size(), rows.size());
  size_t i = 0;
  std::map<std::string, UsageCounts> lost;
  for (const auto& [key, counts] : rows) {
    const UsageRow& row = (*unpacked)[i++];
    EXPECT_EQ(row.series, key.first);
    EXPECT_EQ(row.hour, key.second);
    EXPECT_EQ(row.counts[UsageField::kDecisions], counts[UsageField::kDecisions]);
    for (size_t field = 0; field < kUsageFields; ++field) {
      const double difference = row.counts.values[field] - counts.values[field];
      EXPECT_LE(std::abs(difference), counts.values[field] / 1500 + 1e-10) << field;
      lost[key.first].values[field] += difference;
    }
  }
  for (const auto& [series, counts] : lost) {
    for (size_t field = 0; field < kUsageFields; ++field) {
      EXPECT_NEAR(counts.values[field], 0.0, field == 9 ? 0.01 : 1e-8) << field;
    }
    EXPECT_EQ(counts[UsageField::kSpikes], 0.0);
  }
  EXPECT_EQ(UsageSeries::FromKey(unpacked->back().series).label, "robot \"1\"");
}

TEST(UsageRows, RefusesWhatIsDamaged) {
  const std::string packed = PackRows({{{Series(1, 1), 7}, UsageCounts()}});
  for (size_t i = 0; i < packed.size(); ++i) {
    EXPECT_FALSE(UnpackRows(packed.substr(0, i)).ok()) << i;
    std::string changed = packed;
    changed[i] = static_cast<char>(changed[i] ^ 0x55);
    UnpackRows(changed).IgnoreError();  // an error or other rows, but no crash
  }
}

TEST(UsageRows, BeyondTheLimitOfSeriesOtherTakesTheRest) {
  std::vector<UsageRow> more;
  UsageCounts one;
  one[UsageField::kDecisions] = 1;
  for (int i = 0; i < static_cast<int>(kMostSeries) + 50; ++i)
    more.push_back({Series(i % 2, i), 5, one});
  UsageRows rows;
  Merge("h20260101", more, &rows);
  EXPECT_LE(rows.size(), kMostSeries + 2);
  double others = 0;
  for (const int tenant : {0, 1}) {
    others += rows.at({OtherSeries(Series(tenant, 0)), 5})[UsageField::kDecisions];
  }
  EXPECT_EQ(others, 50);
}

class LocalUsageStoreTest : public testing::Test {
 protected:
  LocalUsageStoreTest() : folder_(testing::TempDir() + "/usage_store_test") {
    std::filesystem::remove_all(folder_);
    Open();
  }
  ~LocalUsageStoreTest() override { std::filesystem::remove_all(folder_); }

  // Opens the folder, again.
  void Open() {
    store_ = nullptr;
    auto opened = LocalUsageStore::Open(folder_, &clock_);
    ASSERT_TRUE(opened.ok()) << opened.status();
    store_ = *std::move(opened);
  }
  UsageCounts Sum(absl::Time from, absl::Time to) {
    const auto rows = ReadUsage(*store_, from, to);
    EXPECT_TRUE(rows.ok()) << rows.status();
    return SumOf(*rows);
  }

  FakeClock clock_;
  const std::string folder_;
  std::unique_ptr<LocalUsageStore> store_;
};

TEST_F(LocalUsageStoreTest, BooksTheTotalsOfASessionOnce) {
  const auto book = [&](double decisions, double spikes) {
    UsageBatch batch = {.source = "any", .number = 1, .time = Day(11, 30)};
    batch.totals = {{.session = "id", .series = Series(1, 1), .totals = {decisions, spikes, 0.0}}};
    ASSERT_TRUE(store_->Book(batch).ok());
  };
  book(5, 50);
  book(5, 50);  // by another server
  book(3, 30);  // by one that has an old copy
  Open();
  book(7, 70);
  const UsageCounts sum = Sum(Day(11, 1), Day(12, 1));
  EXPECT_EQ(sum[UsageField::kDecisions], 7);
  EXPECT_EQ(sum[UsageField::kSpikes], 70);
  EXPECT_EQ(store_->BookedDecisions("id"), 7);
  clock_.Advance(absl::Hours(2));
  Open();  // the time without a server makes the totals no older
  clock_.Advance(absl::Hours(1));
  ASSERT_TRUE(store_->Forget(absl::Hours(1)).ok());
  ASSERT_TRUE(store_->ForgetAllBut({"id"}).ok());
  EXPECT_EQ(store_->BookedDecisions("id"), 7);
  clock_.Advance(absl::Seconds(2));
  ASSERT_TRUE(store_->Forget(absl::Hours(1)).ok());
  EXPECT_EQ(store_->BookedDecisions("id"), 0);
  EXPECT_EQ(store_->MonthOf(Day(11, 3))->at("tenant-1")[UsageField::kDecisions], 7);
}

TEST_F(LocalUsageStoreTest, CompactsHoursToDaysAndMonths) {
  uint64_t number = 0;
  for (const auto& [month, day] : {std::pair(1, 1), std::pair(1, 2), std::pair(1, 31)}) {
    for (int hour = 0; hour < 24; hour += 6) {
      ASSERT_TRUE(store_->Book(Batch(++number, Day(month, day, hour))).ok());
    }
  }
  const auto rows_at = [&](absl::Time now) {
    for (int i = 0; i < 3; ++i) EXPECT_TRUE(CompactUsage(*store_, now).ok());
    Open();
    const auto rows = ReadUsage(*store_, Day(1, 1), Day(2, 1));
    const UsageCounts sum = SumOf(*rows);
    EXPECT_EQ(sum[UsageField::kDecisions], 36);
    EXPECT_EQ(sum[UsageField::kSpikes], 12'000);
    EXPECT_NEAR(sum[UsageField::kHorowitz45nm], 24e-6, 1e-9);
    return rows->size();
  };
  EXPECT_EQ(rows_at(Day(1, 31, 23)), 12);
  EXPECT_EQ(store_->Parts()->size(), 3);  // days
  EXPECT_EQ(rows_at(Day(2, 10)), 6);      // the first days are old
  EXPECT_EQ(rows_at(Day(4, 1)), 3);
  EXPECT_EQ(*store_->Parts(), std::vector<std::string>{"d202601"});
  EXPECT_EQ(rows_at(Day(12, 31)), 3);
  EXPECT_EQ(rows_at(Day(12, 31) + absl::Hours(24 * 70)), 1);
  EXPECT_EQ(*store_->Parts(), std::vector<std::string>{"m2026"});
}

// Every series in every hour, written and compacted by the hour. USAGE_DAYS=31 writes a month of
// 1,000 tenants with 10 policies each.
TEST_F(LocalUsageStoreTest, AMonthOfAThousandTenantsWithTenPoliciesIsBelow50Megabytes) {
  const char* const text = std::getenv("USAGE_DAYS");  // NOLINT(concurrency-mt-unsafe)
  const int days = text == nullptr ? 1 : std::atoi(text), tenants = text == nullptr ? 2 : 1000;
  std::mt19937 random(1);
  double decisions = 0, spikes = 0;
  for (int hour = 0; hour < 24 * days; ++hour) {
    const absl::Time time = Day(1, 1) + absl::Hours(hour);
    UsageBatch batch = {.source = "any", .number = 1, .time = time + absl::Minutes(59)};
    for (int series = 0; series < 10 * tenants; ++series) {
      const UsageCounts counts = Hour(&random);
      batch.added[Series(series / 10, series % 10)] = counts;
      decisions += counts[UsageField::kDecisions];
      spikes += counts[UsageField::kSpikes];
    }
    ASSERT_TRUE(store_->Book(batch).ok());
    ASSERT_TRUE(CompactUsage(*store_, time + absl::Minutes(66)).ok());
  }
  Open();
  const UsageCounts sum = Sum(Day(1, 1), Day(2, 1));
  EXPECT_EQ(sum[UsageField::kDecisions], decisions);
  EXPECT_EQ(sum[UsageField::kSpikes], spikes);
  EXPECT_EQ(store_->Parts()->size(), days);
  const auto bytes = std::filesystem::file_size(folder_ + "/data.mdb");
  std::printf("%d tenants, %d days: a file of %.1f MB\n", tenants, days, 1e-6 * bytes);
  EXPECT_LT(bytes, 50'000'000);
}

TEST_F(LocalUsageStoreTest, AReplacementThatComesLateChangesNothing) {
  ASSERT_TRUE(store_->Book(Batch(1, Day(1, 1))).ok());
  const auto source = store_->Read(OpenPart(Day(1, 1)));
  ASSERT_TRUE(store_->Book(Batch(2, Day(1, 1))).ok());
  ASSERT_TRUE(store_->Replace(*source, {.name = "h20260101"}, PackRows({})).ok());
  EXPECT_EQ(Sum(Day(1, 1), Day(2, 1))[UsageField::kDecisions], 6);
}

TEST_F(LocalUsageStoreTest, BeginsAgainBesideADamagedFile) {
  ASSERT_TRUE(store_->Book(Batch(1, Day(1, 1))).ok());
  store_ = nullptr;
  std::filesystem::resize_file(folder_ + "/data.mdb", 5000);
  Open();
  ASSERT_NE(store_, nullptr);
  EXPECT_EQ(Sum(Day(1, 1), Day(2, 1)), UsageCounts());
  EXPECT_TRUE(std::filesystem::exists(folder_ + "/data.mdb.damaged"));
}

}  // namespace
}  // namespace spikeserve
