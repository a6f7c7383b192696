#include "core/cli/program.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>
#include <iostream>
#include <map>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "absl/time/time.h"
#include "core/base/version.h"
#include "core/cli/printable_output.h"
#include "tests/support/files.h"

namespace spikeserve {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;
using ::testing::StartsWith;

// What a run left behind.
struct Outcome {
  int exit_status = 0;
  std::string output;
  std::string errors;
  std::string action;        // of the command that ran; empty if none did
  std::string command_line;  // as that command saw it
};

// The program "demo": `fly`, `tower open` and `tower close`.
class ProgramTest : public DirectoryTest {
 protected:
  ~ProgramTest() override {
    for (const auto& [name, value] : environment_) unsetenv(name.c_str());
  }

  void SetVariable(const std::string& name, const std::string& value) {
    environment_[name] = value;
    setenv(name.c_str(), value.c_str(), /*overwrite=*/1);
  }

  // Writes a file of flags and returns its path.
  std::string WriteConfig(const std::string& text) {
    const std::string path = Path("demo.toml");
    std::ofstream(path) << text;
    return path;
  }

  Outcome Run(std::vector<std::string> arguments) {
    flags_ = Flags();
    Program program("demo", "Flies");
    Outcome outcome;
    const auto action = [&](const std::string& name) {
      return [&outcome, &program, name] {
        outcome.action = name;
        outcome.command_line = program.CommandLine();
        return absl::OkStatus();
      };
    };
    program.root().Flags("Demo").Add("server", "HOST:PORT", &flags_.server, "Address");
    const Command fly = program.root().AddCommand("fly", "Flies away");
    fly.Flags("Flying")
        .Add("height", "N", &flags_.height, "Height in metres")
        .Add("seed", "N", &flags_.seed, "Seed")
        .Add("speed", "X", &flags_.speed, "Speed")
        .Add("wait", "DURATION", &flags_.wait, "Time before the start")
        .AddList("places", "NAME,...", &flags_.places, "Places to see")
        .AddSwitch("fast", &flags_.fast, "Flies fast");
    fly.Flags("Route").Add("route", "FILE", &flags_.route, "Route");
    fly.RefuseBeside("route", "Flying");
    fly.SetAction(action("fly"));
    const Command tower = program.root().AddCommand("tower", "Talks to the tower");
    tower.AddCommand("open", "Opens").SetAction(action("open"));
    const Command close = tower.AddCommand("close", "Closes");
    close.Flags("Closing").Add("version", "N", &flags_.version, "Version of the tower");
    close.SetAction(action("close"));

    std::vector<const char*> argv = {"demo"};
    for (const std::string& argument : arguments) argv.push_back(argument.c_str());
    ::testing::internal::CaptureStdout();
    ::testing::internal::CaptureStderr();
    outcome.exit_status = program.Run(static_cast<int>(argv.size()), argv.data());
    outcome.output = ::testing::internal::GetCapturedStdout();
    outcome.errors = ::testing::internal::GetCapturedStderr();
    return outcome;
  }

  void ExpectError(const std::vector<std::string>& arguments, const std::string& message) {
    const Outcome outcome = Run(arguments);
    EXPECT_EQ(outcome.exit_status, 1);
    EXPECT_EQ(outcome.errors, "demo: " + message + "\n");
    EXPECT_EQ(outcome.output, "");
    EXPECT_EQ(outcome.action, "");
  }

  struct Flags {
    std::string server = "localhost:1";
    int height = 100;
    uint64_t seed = 0;
    std::optional<double> speed;
    absl::Duration wait = absl::Seconds(10);
    std::vector<std::string> places = {"here"};
    bool fast = false;
    std::string route;
    int version = 0;
  };

  Flags flags_;
  std::map<std::string, std::string> environment_;
};

TEST_F(ProgramTest, AValueFollowsAnEqualsSignOrABlank) {
  EXPECT_EQ(Run({"fly", "--height=5", "--speed", "-1.5", "--wait=1.5m", "--fast"}).errors, "");
  EXPECT_EQ(flags_.height, 5);
  EXPECT_EQ(flags_.speed, -1.5);
  EXPECT_EQ(flags_.wait, absl::Seconds(90));
  EXPECT_TRUE(flags_.fast);
  EXPECT_EQ(Run({"fly", "--fast", "--fast=false"}).errors, "");
  EXPECT_FALSE(flags_.fast);
}

TEST_F(ProgramTest, AnEmptyValueIsAValue) {
  EXPECT_EQ(Run({"fly", "--server=", "--height=5", "--places="}).errors, "");
  EXPECT_EQ(flags_.server, "");
  EXPECT_EQ(flags_.height, 5);
  EXPECT_THAT(flags_.places, IsEmpty());
}

TEST_F(ProgramTest, AListIsSeparatedByCommas) {
  Run({"fly", "--places=a,b"});
  EXPECT_THAT(flags_.places, ElementsAre("a", "b"));
  Run({"fly", "--places", "a", "--places=b,c"});
  EXPECT_THAT(flags_.places, ElementsAre("a", "b", "c"));
}

TEST_F(ProgramTest, FlagsOfTheProgramMayStandBeforeAndBehindTheCommand) {
  EXPECT_EQ(Run({"--server=a:1", "fly"}).errors, "");
  EXPECT_EQ(flags_.server, "a:1");
  EXPECT_EQ(Run({"tower", "open", "--server=a:2"}).action, "open");
  EXPECT_EQ(flags_.server, "a:2");
}

TEST_F(ProgramTest, ErrorsSayWhatWasExpectedAndReceived) {
  ExpectError({"fly", "--height=many"}, "--height: expected an integer, received \"many\"");
  ExpectError({"fly", "--height="}, "--height: expected an integer, received \"\"");
  ExpectError({"fly", "--seed=-1"}, "--seed: expected an integer of at least 0, received \"-1\"");
  ExpectError({"fly", "--speed=x"}, "--speed: expected a number, received \"x\"");
  ExpectError({"fly", "--wait=ten"},
              "--wait: expected a duration such as 250ms, 10s or 1.5m, received \"ten\"");
  ExpectError({"fly", "--fast=maybe"}, "--fast: expected true or false, received \"maybe\"");
  ExpectError({"fly", "--height"}, "--height: expected N, received none");
  ExpectError({"fly", "home"}, "fly: expected flags alone, received \"home\"");
  ExpectError({"fly", "tower"}, "fly: expected flags alone, received \"tower\"");
  ExpectError({"fly", "--deep=3"},
              "--deep: expected a flag of demo fly (see demo fly --help), received --deep=3");
  ExpectError({"tower", "open", "--height=3"},
              "--height: expected a flag of demo tower open (see demo tower open --help), received "
              "--height=3");
  ExpectError({}, "command: expected one of fly, tower, received none");
  ExpectError({"swim"}, "command: expected one of fly, tower, received \"swim\"");
  ExpectError({"tower"}, "tower: expected one of open, close, received none");
  ExpectError({"tower", "fly"}, "tower: expected one of open, close, received \"fly\"");
}

TEST_F(ProgramTest, AFlagWithoutEffectIsRefusedOnTheCommandLineAlone) {
  ExpectError({"fly", "--route=file", "--height=3"},
              "--height: expected no such flag beside --route, received 3");
  SetVariable("DEMO_HEIGHT", "3");
  EXPECT_EQ(Run({"fly", "--route=file"}).errors, "");
}

TEST_F(ProgramTest, AFileIsReadStrictly) {
  const std::pair<std::string, std::string> cases[] = {
      {"height = 3\n", "expected flags of demo, received \"height\""},
      {"[fly]\nserver = a\n", "expected flags of fly, received \"server\""},
      {"help = true\n", "expected flags of demo, received \"help\""},
      {"[swim]\ndepth = 3\n", "expected sections named as commands, received [swim]"},
      {"[tower.fly]\nheight = 3\n", "expected sections named as commands, received [tower.fly]"},
      {"[fly]\nheight = [1, 2]\n", "--height: expected one value, received \"1,2\""},
  };
  for (const auto& [text, message] : cases) {
    const std::string config = WriteConfig(text);
    ExpectError({"fly", "--config=" + config}, config + ": " + message);
  }
  ExpectError({"fly", "--config=/nowhere"},
              "--config: expected a file that can be read, received \"/nowhere\"");
  SetVariable("DEMO_CONFIG", "/nowhere");
  ExpectError({"fly"}, "--config: expected a file that can be read, received \"/nowhere\"");
}

TEST_F(ProgramTest, AFileHasListsCommentsAndNestedSections) {
  const std::string config = WriteConfig(
      "# where to\n[fly]\nplaces = [\"a\", \"b\"]\nwait = \"2s\"\n[tower.close]\nversion = 7\n");
  EXPECT_EQ(Run({"fly", "--config=" + config}).errors, "");
  EXPECT_THAT(flags_.places, ElementsAre("a", "b"));
  EXPECT_EQ(flags_.wait, absl::Seconds(2));
  EXPECT_EQ(flags_.version, 7);
}

TEST_F(ProgramTest, TheCommandLineOfAnActionHasEveryFlagThatIsSet) {
  const std::string config = WriteConfig("[fly]\nspeed = 2\n");
  SetVariable("DEMO_SERVER", "variable:1");
  EXPECT_EQ(Run({"fly", "--fast", "--config=" + config, "--places", "a,b"}).command_line,
            "demo --server=variable:1 fly --speed=2 --places=a,b --fast");
}

TEST_F(ProgramTest, Help) {
  const Outcome program = Run({"--help"});
  EXPECT_EQ(program.exit_status, 0);
  EXPECT_THAT(program.output, StartsWith("Flies\nUsage: demo COMMAND [--FLAG=VALUE ...]\n"));
  EXPECT_THAT(program.output, HasSubstr("  fly                           Flies away\n"));
  EXPECT_THAT(program.output, HasSubstr("  --server HOST:PORT            Address [localhost:1]\n"));
  EXPECT_THAT(program.output, HasSubstr("variable DEMO_<FLAG>"));
  EXPECT_THAT(program.output, Not(HasSubstr("--height")));

  const Outcome fly = Run({"fly", "--help"});
  EXPECT_EQ(fly.action, "");
  EXPECT_THAT(fly.output, StartsWith("Flies away\nUsage: demo fly [--FLAG=VALUE ...]\n"));
  EXPECT_THAT(fly.output,
              HasSubstr("  --wait DURATION               Time before the start [10s]\n"));
  EXPECT_THAT(fly.output, HasSubstr("  --fast                        Flies fast\n"));
  EXPECT_THAT(fly.output, HasSubstr("--server"));
  EXPECT_THAT(fly.output, HasSubstr("-h,--help"));
  EXPECT_THAT(Run({"-h", "fly"}).output, Not(IsEmpty()));
}

TEST_F(ProgramTest, Version) {
  const std::string version = "demo " + std::string(Version()) + "\n";
  EXPECT_EQ(Run({"--version"}).output, version);
  EXPECT_EQ(Run({"fly", "--version"}).output, version);
  // A command's own flag of that name is another one.
  EXPECT_EQ(Run({"tower", "close", "--version=3"}).output, "");
  EXPECT_EQ(flags_.version, 3);
  EXPECT_THAT(Run({"tower", "close", "--help"}).output, Not(HasSubstr("Print the version")));
}

// Returns what reaches the terminal when `write` writes to std::cout.
template <typename Write>
std::string Shown(Write write) {
  std::ostringstream terminal;
  std::streambuf* const before = std::cout.rdbuf(terminal.rdbuf());
  {
    const PrintableOutput output;
    write(std::cout);
    std::cout << std::flush;
  }
  std::cout.rdbuf(before);
  return terminal.str();
}

TEST(PrintableOutput, PassesTextsOn) {
  EXPECT_EQ(Shown([](std::ostream& out) { out << "a\tMüller " << 7 << std::endl; }),
            "a\tMüller 7\n");
}

TEST(PrintableOutput, EscapesWhatATerminalObeys) {
  EXPECT_EQ(Shown([](std::ostream& out) { out << "\x1b]52;c;\x07 a\rb \xc2\x9b"; }),
            "\\u001b]52;c;\\u0007 a\\u000db \\u00c2\\u009b");
}

TEST(PrintableOutput, KnowsCharactersThatComeInParts) {
  EXPECT_EQ(Shown([](std::ostream& out) { out << '\xc3' << '\xbc'; }), "ü");
  EXPECT_EQ(Shown([](std::ostream& out) { out << '\xc3' << std::flush << "a"; }), "\\u00c3a");
}

}  // namespace
}  // namespace spikeserve
