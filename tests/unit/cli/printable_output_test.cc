#include "core/cli/printable_output.h"

#include <gtest/gtest.h>

#include <iostream>
#include <sstream>
#include <string>

namespace spikeserve {
namespace {

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
