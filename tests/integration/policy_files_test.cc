// Tests that a policy that cannot be served is refused with its path and the reason, and that the
// others are served.
#include <fstream>
#include <sstream>

#include "core/model/policy.h"
#include "core/model/policy_file.h"
#include "nlohmann/json.hpp"
#include "tests/integration/server_fixture.h"
#include "tests/support/small_config.h"

namespace spikeserve {
namespace {

using ::testing::AllOf;
using ::testing::HasSubstr;

namespace fs = std::filesystem;

class PolicyFilesTest : public ServerTest {
 protected:
  std::string GoodFile() {
    std::ostringstream bytes;
    bytes << std::ifstream(policies_.path() / "box/1/policy.safetensors", std::ios::binary).rdbuf();
    return bytes.str();
  }

  // Writes `bytes` as the file of a policy and returns its path.
  std::string Write(const std::string& name, const std::string& bytes,
                    const std::string& version = "1") {
    const fs::path path = policies_.path() / name / version / "policy.safetensors";
    fs::create_directories(path.parent_path());
    std::ofstream(path, std::ios::binary) << bytes;
    return path.string();
  }

  // Expects exactly one log line, which names `path` and contains `reason`, and that the valid
  // policies are served.
  void ExpectRefused(const std::string& path, const std::string& reason) {
    StartServer();
    const std::string log = server_->Log();
    const std::string start = " warning policy refused error=\"" + path + ": ";
    const size_t line = log.find(start);
    ASSERT_NE(line, std::string::npos) << log;
    EXPECT_THAT(log.substr(line, log.find('\n', line) - line), HasSubstr(reason));
    EXPECT_EQ(std::count(log.begin(), log.end(), '\n'), 1) << log;
    v1::ListPoliciesResponse list;
    ASSERT_TRUE(client_->stub().ListPolicies(NewContext().get(), {}, &list).ok());
    EXPECT_EQ(list.policies_size(), 3);
    client_->Act(client_->Open("box"), 0);
  }
};

TEST_F(PolicyFilesTest, Truncated) {
  const std::string good = GoodFile();
  ExpectRefused(Write("bad", good.substr(0, good.size() / 2)), "data_offsets");
}

TEST_F(PolicyFilesTest, Garbage) { ExpectRefused(Write("bad", "this is not a policy"), "header"); }

TEST_F(PolicyFilesTest, NotANumber) {
  std::string bytes = GoodFile();
  bytes.replace(bytes.size() - 4, 4, std::string("\0\0\xc0\x7f", 4));
  ExpectRefused(Write("bad", bytes), "finite");
}

// All numbers in the file are finite; only a decision shows that the policy computes others.
TEST_F(PolicyFilesTest, ADecisionThatIsNotFinite) {
  ModelConfig config = SmallConfig();
  config.mode = Mode::kDense;
  Policy policy = RandomPolicy(config, kObservationSize, ActionSpace::Discrete(2), /*seed=*/1);
  for (float& weight : policy.weights.layers[0].query.weight.values) weight = 3e38f;
  const fs::path folder = policies_.path() / "bad" / "1";
  fs::create_directories(folder);
  const std::string path = (folder / "policy.safetensors").string();
  ASSERT_TRUE(WritePolicyFile(policy, path).ok());
  ExpectRefused(path, "expected a finite first decision");
}

TEST_F(PolicyFilesTest, Empty) { ExpectRefused(Write("bad", ""), "bytes"); }

TEST_F(PolicyFilesTest, Missing) {
  fs::create_directories(policies_.path() / "bad/1");
  std::ofstream(policies_.path() / "bad/1/notes.txt") << "an empty folder would be ignored";
  ExpectRefused((policies_.path() / "bad/1/policy.safetensors").string(), "no such file");
}

TEST_F(PolicyFilesTest, VersionsArePositiveIntegers) {
  for (const std::string version : {"latest", "0", "-1", "01", "1.5"}) {
    Write("discrete", GoodFile(), version);
    ExpectRefused((policies_.path() / "discrete" / version).string(),
                  "expected a version, a positive integer");
    fs::remove_all(policies_.path() / "discrete" / version);
  }
}

TEST_F(PolicyFilesTest, ABadNewerVersionLeavesTheOlderTheDefault) {
  Write("discrete", "garbage", "10");
  StartServer();
  v1::OpenSessionRequest request;
  request.set_policy("discrete");
  v1::OpenSessionResponse opened;
  ASSERT_TRUE(client_->stub().OpenSession(NewContext().get(), request, &opened).ok());
  EXPECT_EQ(opened.version(), 2);
}

TEST_F(PolicyFilesTest, VersionsOrderAsNumbers) {
  Write("box", GoodFile(), "10");
  Write("box", GoodFile(), "9");
  StartServer();
  v1::OpenSessionRequest request;
  request.set_policy("box");
  v1::OpenSessionResponse opened;
  ASSERT_TRUE(client_->stub().OpenSession(NewContext().get(), request, &opened).ok());
  EXPECT_EQ(opened.version(), 10);
}

TEST_F(PolicyFilesTest, TheLogIsJsonIfAskedFor) {
  const std::string path = Write("bad", "this is not a policy");
  StartServer({"--log_format=json"});
  const auto line = nlohmann::json::parse(server_->Log(), nullptr, /*allow_exceptions=*/false);
  ASSERT_TRUE(line.is_object()) << server_->Log();
  EXPECT_EQ(line["level"], "warning");
  EXPECT_EQ(line["message"], "policy refused");
  EXPECT_THAT(line["error"].get<std::string>(), HasSubstr(path));
}

// Starts a server of `directory` that must refuse to start, and returns the reason.
std::string RefusedStart(const fs::path& directory) {
  const auto server = ServerProcess::Start(directory.string());
  EXPECT_FALSE(server.ok());
  return std::string(server.status().message());
}

TEST_F(PolicyFilesTest, NothingToServeStopsTheStartWithWhatToDo) {
  const TemporaryDirectory empty;
  EXPECT_THAT(RefusedStart(empty.path()),
              AllOf(HasSubstr("--policies: " + empty.path().string() +
                              ": expected <policy>/<version>/policy.safetensors"),
                    HasSubstr("the directory has no policies"), HasSubstr("--allow_no_policies")));
  fs::create_directories(empty.path() / "bad/1");
  std::ofstream(empty.path() / "bad/1/notes.txt") << "an empty folder would be ignored";
  EXPECT_THAT(RefusedStart(empty.path()),
              HasSubstr((empty.path() / "bad/1/policy.safetensors").string()));
}

TEST_F(PolicyFilesTest, ADirectoryOfTheWrongLevelNamesTheRightOne) {
  const std::string right = "use --policies=" + policies_.path().string() + ".";
  EXPECT_THAT(RefusedStart(policies_.path() / "discrete"),
              AllOf(HasSubstr("the folder of one policy"), HasSubstr(right)));
  EXPECT_THAT(RefusedStart(policies_.path() / "discrete" / ""), HasSubstr(right));
  EXPECT_THAT(RefusedStart(policies_.path() / "discrete" / "1"),
              AllOf(HasSubstr("the folder of one version"), HasSubstr(right)));
  const TemporaryDirectory above;
  fs::rename(policies_.path() / "box", above.path() / "box");
  fs::create_directories(above.path() / "policies");
  fs::rename(above.path() / "box", above.path() / "policies" / "box");
  EXPECT_THAT(RefusedStart(above.path()),
              AllOf(HasSubstr("a directory above the policies"),
                    HasSubstr("use --policies=" + (above.path() / "policies").string())));
}

TEST_F(PolicyFilesTest, NothingIsServedIfThatIsMeant) {
  const TemporaryDirectory empty;
  const auto server = ServerProcess::Start(empty.path().string(), {"--allow_no_policies"});
  ASSERT_TRUE(server.ok()) << server.status();
  EXPECT_THAT((*server)->Log(),
              AllOf(HasSubstr("no policy is served"), HasSubstr(empty.path().string())));
}

}  // namespace
}  // namespace spikeserve
