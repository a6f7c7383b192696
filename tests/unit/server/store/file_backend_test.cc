#include "server/store/file_backend.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/resource.h>
#include <unistd.h>

#include <fstream>

#include "core/journal/session_journal.h"
#include "tests/support/fake_clock.h"
#include "tests/support/files.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using Kind = JournalRecord::Kind;

constexpr char kId[] = "0123456789abcdef0123456789abcdef";
constexpr char kOtherId[] = "0123456789abcdef0123456789abcdf0";

class NoWriter final : public JournalWriter {
  void Write(JournalRecord /*record*/) override {}
  void Hurry() override {}
  absl::Status CheckReachable() const override { return absl::OkStatus(); }
  absl::Status CheckBacklog() const override { return absl::OkStatus(); }
};

class FileBackendTest : public ::testing::Test {
 protected:
  FileBackendTest() { Open(); }

  void Open(absl::Duration retention = absl::Hours(1)) {
    backend_ = nullptr;
    auto opened = OpenFileBackend(
        Folder(), retention, [this] { return now_; }, &clock_);
    ASSERT_TRUE(opened.ok()) << opened.status();
    backend_ = *std::move(opened);
  }

  std::string Folder() const { return (folder_.path() / "store").string(); }

  JournalRecord Record(Kind kind, const std::string& bytes, uint64_t decisions, uint64_t epoch = 1,
                       const std::string& id = kId) {
    return {.kind = kind,
            .bytes = bytes,
            .decisions = decisions,
            .journal = std::make_shared<SessionJournal>(
                SessionJournal::Key{.id = id, .tenant = "t", .epoch = epoch}, Durability::kSync,
                /*decisions=*/0, &writer_)};
  }

  std::vector<absl::StatusCode> Write(const std::vector<JournalRecord>& records) {
    const auto outcomes = backend_->Write(records);
    EXPECT_TRUE(outcomes.ok()) << outcomes.status();
    std::vector<absl::StatusCode> codes;
    if (outcomes.ok()) {
      for (const absl::Status& outcome : *outcomes) codes.push_back(outcome.code());
    }
    return codes;
  }

  absl::StatusOr<ClaimedJournal> Claim(const std::string& id, const std::string& tenant = "t") {
    return backend_->Claim({{.id = id, .tenant = tenant, .has_policy = nullptr}}).front();
  }

  std::vector<std::string> Claimed(const std::string& id = kId) {
    const auto journal = Claim(id);
    EXPECT_TRUE(journal.ok()) << journal.status();
    return journal.ok() ? journal->records : std::vector<std::string>();
  }

  static constexpr absl::StatusCode kOk = absl::StatusCode::kOk;
  static constexpr absl::StatusCode kAborted = absl::StatusCode::kAborted;

  TemporaryDirectory folder_;
  // Lets time pass while the store is open.
  void Pass(absl::Duration time) {
    now_ += time;
    clock_.Advance(time);
  }

  absl::Time now_ = absl::FromUnixSeconds(1'000'000);
  FakeClock clock_;
  NoWriter writer_;
  std::unique_ptr<JournalBackend> backend_;
};

TEST_F(FileBackendTest, AFormerOwnerIsRefused) {
  Write({Record(Kind::kOpen, "open", 0)});
  const auto claimed = Claim(kId);
  ASSERT_TRUE(claimed.ok()) << claimed.status();
  EXPECT_EQ(claimed->epoch, 2u);
  EXPECT_THAT(Write({Record(Kind::kEntry, "old", 1, 1), Record(Kind::kEntry, "new", 1, 2),
                     Record(Kind::kSnapshot, "old", 2, 1), Record(Kind::kClose, "", 2, 1)}),
              ElementsAre(kAborted, kOk, kAborted, kAborted));
  EXPECT_THAT(Claimed(), ElementsAre("open", "new"));
}

TEST_F(FileBackendTest, SessionsThatNothingWasWrittenToAreRemovedAtTheNextStart) {
  Write({Record(Kind::kOpen, "old", 0), Record(Kind::kOpen, "used", 0, 1, kOtherId)});
  Pass(absl::Minutes(40));
  Write({Record(Kind::kEntry, "1", 1, 1, kOtherId)});
  Open();
  Pass(absl::Minutes(40));
  Write({Record(Kind::kEntry, "2", 2, 1, kOtherId)});
  Open();
  EXPECT_EQ(Claim(kId).status().code(), absl::StatusCode::kNotFound);
  EXPECT_THAT(Claimed(kOtherId), ElementsAre("used", "1", "2"));
}

TEST_F(FileBackendTest, OpensWhereTheProcessMayMapLittle) {
  backend_ = nullptr;
  rlimit before;
  ASSERT_EQ(getrlimit(RLIMIT_AS, &before), 0);
  rlim_t mapped_pages = 0;
  std::ifstream("/proc/self/statm") >> mapped_pages;
  const rlim_t limit = mapped_pages * sysconf(_SC_PAGESIZE) + (rlim_t{16} << 30);
  const rlimit little = {.rlim_cur = limit, .rlim_max = before.rlim_max};
  ASSERT_EQ(setrlimit(RLIMIT_AS, &little), 0);
  Open();
  ASSERT_EQ(setrlimit(RLIMIT_AS, &before), 0);
  EXPECT_THAT(Write({Record(Kind::kOpen, "open", 0)}), ElementsAre(absl::StatusCode::kOk));
}

TEST_F(FileBackendTest, AFileInThePlaceOfTheFolderIsRefused) {
  const auto opened = OpenFileBackend(Folder() + "/data.mdb", absl::Hours(1));
  EXPECT_EQ(opened.status().code(), absl::StatusCode::kInvalidArgument) << opened.status();
}

}  // namespace
}  // namespace spikeserve
