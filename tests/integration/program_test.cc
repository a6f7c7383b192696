// Tests of the program spikeserve: its output and its failures.

#include "tests/integration/server_fixture.h"
#include "tests/integration/subprocess.h"

namespace spikeserve {
namespace {

using ::testing::HasSubstr;

class ProgramTest : public ServerTest {
 protected:
  // Expects that the program fails with one line on standard error, which contains `message`.
  void ExpectFailure(std::vector<std::string> flags, const std::string& message) {
    flags.insert(flags.begin(), SPIKESERVE_PROGRAM);
    const auto finished = RunToEnd(flags);
    ASSERT_TRUE(finished.ok()) << finished.status();
    EXPECT_NE(finished->exit_code, 0);
    EXPECT_EQ(finished->output, "");
    EXPECT_THAT(finished->errors, HasSubstr(message));
    EXPECT_EQ(std::count(finished->errors.begin(), finished->errors.end(), '\n'), 1)
        << finished->errors;
  }

  std::string policies() const { return "--policies=" + policies_.path().string(); }
};

TEST_F(ProgramTest, BadFlags) {
  ExpectFailure({}, "--policies: expected a directory, received none");
  ExpectFailure({"--policies=/nonexistent"}, "--policies: /nonexistent: No such file");
  ExpectFailure({policies(), "--listen=50051"}, "--listen: expected HOST:PORT, received \"50051\"");
  ExpectFailure({policies(), "--listen=127.0.0.1:70000"}, "--listen: expected HOST:PORT");
  ExpectFailure({policies(), "--http_listen=,:1"}, "--http_listen: expected HOST:PORT");
  ExpectFailure({policies(), "--session_ttl=0s"}, "--session_ttl: expected at least 1ms");
  ExpectFailure({policies(), "--compact_after=0s"}, "--compact_after: expected at least 1ms");
  ExpectFailure({policies(), "--max_sessions=0"}, "--max_sessions: expected at least 1");
  ExpectFailure({policies(), "--max_message_bytes=0"}, "--max_message_bytes: expected 1 to");
  ExpectFailure({policies(), "--session_ttl=soon"},
                "--session_ttl: expected a duration such as 250ms, 10s or 1.5m, received \"soon\"");
  ExpectFailure({policies(), "--drain_timeout=-1s"}, "--drain_timeout: expected");
  ExpectFailure({policies(), "extra"}, "expected flags alone, received \"extra\"");
  ExpectFailure({policies(), "--unknown=1"}, "--unknown: expected a flag of spikeserve");
}

TEST_F(ProgramTest, ADirectoryThatCannotBeRecordedIntoStopsTheStart) {
  // Not even a superuser can create folders in /proc.
  for (const std::string directory : {"/proc", "/proc/recordings"}) {
    ExpectFailure({policies(), "--record_dir=" + directory},
                  "--record_dir: expected a directory in which the server can create folders, "
                  "received " +
                      directory);
  }
}

TEST_F(ProgramTest, TakenPorts) {
  ExpectFailure({policies(), "--listen=" + server_->grpc_address(), "--http_listen="},
                "--listen: cannot listen on " + server_->grpc_address());
  ExpectFailure({policies(), "--listen=127.0.0.1:0", "--http_listen=" + server_->http_address()},
                "--http_listen: cannot listen on " + server_->http_address());
}

TEST_F(ProgramTest, HttpIsOptional) {
  const auto process =
      Subprocess::Start({SPIKESERVE_PROGRAM, policies(), "--listen=127.0.0.1:0", "--http_listen="});
  ASSERT_TRUE(process.ok()) << process.status();
  const auto line = (*process)->ReadLine();
  ASSERT_TRUE(line.has_value()) << (*process)->Errors();
  EXPECT_THAT(*line, HasSubstr("spikeserve: serving gRPC on 127.0.0.1:"));
  (*process)->Signal(SIGINT);
  EXPECT_EQ((*process)->ReadLine(), std::nullopt);
  EXPECT_EQ((*process)->Wait(), 0);
}

}  // namespace
}  // namespace spikeserve
