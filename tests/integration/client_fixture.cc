#include "tests/integration/client_fixture.h"

#include <algorithm>

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "core/environment/environment.h"
#include "core/model/policy.h"
#include "core/model/policy_file.h"
#include "tests/support/small_config.h"

namespace spikeserve {
namespace {

void WritePolicyFor(const std::string& id, const std::filesystem::path& policies) {
  const auto environment = MakeEnvironment(id);
  ASSERT_TRUE(environment.ok()) << environment.status();
  Policy policy = RandomPolicy(SmallConfig(), (*environment)->observation_size(),
                               (*environment)->action_space(), /*seed=*/7);
  policy.environment = id;
  policy.target_return = 100.0f;
  const auto directory = policies / absl::AsciiStrToLower(id) / "1";
  std::filesystem::create_directories(directory);
  const absl::Status written = WritePolicyFile(policy, directory / "policy.safetensors");
  ASSERT_TRUE(written.ok()) << written;
}

}  // namespace

void ClientProgramTest::SetUp() {
  for (const char* id : kEnvironments) {
    ASSERT_NO_FATAL_FAILURE(WritePolicyFor(id, policies_.path()));
  }
  StartServer();
}

Finished ClientProgramTest::Spikectl(const std::string& command,
                                     const std::vector<std::string>& flags) {
  return Run({SPIKECTL_PROGRAM, command}, flags);
}

Finished ClientProgramTest::Spikeload(const std::vector<std::string>& flags) {
  return Run({SPIKELOAD_PROGRAM}, flags);
}

Finished ClientProgramTest::Run(std::vector<std::string> arguments,
                                const std::vector<std::string>& flags) {
  arguments.push_back(absl::StrCat("--server=", server_->grpc_address()));
  arguments.insert(arguments.end(), flags.begin(), flags.end());
  const auto finished = RunToEnd(arguments);
  EXPECT_TRUE(finished.ok()) << finished.status();
  return finished.ok() ? *finished : Finished();
}

nlohmann::json ClientProgramTest::ParseOutput(const Finished& finished) {
  EXPECT_EQ(finished.exit_code, 0) << finished.errors;
  EXPECT_EQ(finished.errors, "");
  nlohmann::json json = nlohmann::json::parse(finished.output, nullptr, /*allow_exceptions=*/false);
  EXPECT_TRUE(json.is_object()) << finished.output;
  return json;
}

void ClientProgramTest::ExpectOneLineError(const Finished& finished, const std::string& message) {
  EXPECT_NE(finished.exit_code, 0);
  EXPECT_EQ(finished.output, "");
  EXPECT_THAT(finished.errors, ::testing::HasSubstr(message));
  EXPECT_EQ(std::count(finished.errors.begin(), finished.errors.end(), '\n'), 1) << finished.errors;
}

}  // namespace spikeserve
