// Tests of behaviour that tests/python/learning/test_fleet_learning.py cannot observe over the
// wire.
#include "server/admin/head_handler.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <memory>
#include <string>
#include <vector>

#include "tests/support/fake_clock.h"
#include "tests/support/small_registry.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

class HeadHandlerTest : public ::testing::Test {
 protected:
  std::shared_ptr<const ServedPolicy> Served(const std::string& name, int64_t version = 1) {
    return *registry_.get()->catalog()->Find(name, version);
  }

  // Merges a contribution into the fleet head of version 1.
  void Teach(const std::string& name) {
    const auto served = Served(name);
    const auto size = static_cast<Eigen::Index>(served->policy().weights.head.weight.values.size());
    served->HeadOf("")->Merge(
        {.delta = Eigen::VectorXf::Constant(size, 0.01f), .episode_return = 10.0},
        absl::ZeroDuration());
  }

  absl::StatusOr<v1::PromoteHeadResponse> Promote(const std::string& name, int64_t version) {
    v1::PromoteHeadRequest request;
    request.set_policy(name);
    request.set_version(version);
    v1::PromoteHeadResponse response;
    if (auto status = admin_.PromoteHead(context_, request, &response); !status.ok()) return status;
    return response;
  }

  FakeClock clock_;
  SmallRegistry registry_{"a", "b"};
  SessionStore store_{10, &clock_};
  const std::unique_ptr<Authenticator> authenticator_ = *Authenticator::Create("");
  const std::shared_ptr<const Credential> caller_ = *authenticator_->Authenticate("");
  CallContext context_{.caller = caller_.get()};
  SharedFolder folder_{registry_.get()->directory(), 1 << 30,
                       [](int64_t /*bytes*/, int64_t /*limit*/) {}};
  HeadHandler admin_{registry_.get(), &store_, &folder_};
};

TEST_F(HeadHandlerTest, APromotionNeverTakesANumberThatIsThere) {
  Teach("a");
  // A directory of a version that is not served and has no policy file.
  std::filesystem::create_directories(registry_.path() / "a" / "7");
  const auto promoted = Promote("a", 1);
  ASSERT_TRUE(promoted.ok()) << promoted.status();
  EXPECT_EQ(promoted->version(), 8);
  EXPECT_EQ(Promote("a", 1)->version(), 9);
  EXPECT_EQ(Served("a", 8)->policy().weights.head.weight.values,
            Served("a", 1)->HeadOf("")->Read()->head.weight.values);
  EXPECT_EQ(Served("a", 8)->HeadOf("")->Read()->drift, 0.0);
}

TEST_F(HeadHandlerTest, APromotionThatCannotBeWrittenChangesNothing) {
  Teach("a");
  std::filesystem::remove_all(registry_.path() / "a");
  std::ofstream(registry_.path() / "a") << "in the way";
  EXPECT_FALSE(Promote("a", 1).ok());
  EXPECT_EQ(registry_.get()->catalog()->policies().at("a").versions.size(), 1u);
  EXPECT_GT(Served("a")->HeadOf("")->Read()->drift, 0.0);
}

TEST_F(HeadHandlerTest, ARollbackIsOfOneVersion) {
  Teach("a");
  Teach("b");
  ASSERT_TRUE(Promote("a", 1).ok());
  v1::RollbackHeadRequest request;
  request.set_policy("a");
  request.set_version(1);
  v1::RollbackHeadResponse response;
  ASSERT_TRUE(admin_.RollbackHead(context_, request, &response).ok());
  EXPECT_GT(response.drift(), 0.0);
  EXPECT_EQ(Served("a", 1)->HeadOf("")->Read()->drift, 0.0);
  EXPECT_EQ(Served("a", 2)->HeadOf("")->Read()->rollbacks, 0);
  EXPECT_GT(Served("b")->HeadOf("")->Read()->drift, 0.0);
}

TEST_F(HeadHandlerTest, APauseIsOfOnePolicyOrAllAndOfVersionsYetToCome) {
  const auto paused = [&](const std::string& name, int64_t version = 1) {
    return Served(name, version)->learning->paused();
  };
  v1::PauseLearningRequest pause;
  v1::PauseLearningResponse answer;
  pause.set_policy("a");
  ASSERT_TRUE(admin_.PauseLearning(context_, pause, &answer).ok());
  EXPECT_TRUE(paused("a"));
  EXPECT_FALSE(paused("b"));

  registry_.WriteVersion("a", 2);
  ASSERT_TRUE(registry_.get()->Reload().ok());
  EXPECT_TRUE(paused("a", 2));

  v1::ResumeLearningResponse resumed;
  ASSERT_TRUE(admin_.ResumeLearning(context_, {}, &resumed).ok());
  EXPECT_FALSE(paused("a") || paused("a", 2) || paused("b"));
  pause.clear_policy();
  ASSERT_TRUE(admin_.PauseLearning(context_, pause, &answer).ok());
  EXPECT_TRUE(paused("a") && paused("a", 2) && paused("b"));
}

TEST_F(HeadHandlerTest, NamesWhatIsNotServed) {
  v1::PauseLearningRequest pause;
  v1::PauseLearningResponse answer;
  pause.set_policy("nobody");
  const auto status = admin_.PauseLearning(context_, pause, &answer);
  EXPECT_TRUE(absl::IsNotFound(status));
  EXPECT_THAT(std::string(status.message()), HasSubstr("nobody"));
  EXPECT_TRUE(absl::IsNotFound(Promote("a", 5).status()));
}

}  // namespace
}  // namespace spikeserve
