// Flies random plans (simulator.h). A plan that fails is made as short as it still fails, and
// printed. More of them, with other seeds:
//
//   build/release/tests/robot_test --gtest_filter='*Simulator*' --events=10000000 --seed=1000
//
// What was found with its mend taken out of core/robot, or of the simulated server and link (*):
//
//   a history begins behind the last executed action            "executed" differs
//   NOT_FOUND of one server, or of a restarted one, is final    "a session was given up in vain"
//   an end is forgotten before the store has it                 "the server never got all episodes"
//   what is sent again ignores lost ends                        "the server never got all episodes"
//   answers, or requests, change their order (*)                "an old answer"
//   a step of another robot counts as a repeated one (*)        "reward" differs
//   what an end by datagram overtakes is an error for the session  "a session was given up in vain"
//   a conflict does not end the session                         requests without end
//   late answers are executed; ages stop while the robot sleeps "stale"
#include "tests/unit/robot/simulator.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <fstream>
#include <sstream>

namespace spikeserve::robot {
namespace {

// Returns the number of an argument of the program, such as --events=1000.
uint64_t Argument(const std::string& name, uint64_t usual) {
  for (const std::string& argument : ::testing::internal::GetArgvs()) {
    if (argument.starts_with(name)) return std::stoull(argument.substr(name.size()));
  }
  return usual;
}

// Returns a plan that fails as `plan` does: of no more steps and faults than that takes.
Plan Shrunk(const Kind& kind, Plan plan) {
  const auto take = [&](Plan smaller) {
    if (Fly(kind, smaller).failure.empty()) return false;
    plan = std::move(smaller);
    return true;
  };
  const auto without = [&](size_t begin, size_t size) {
    Plan smaller = plan;
    const auto first = smaller.faults.begin() + static_cast<ptrdiff_t>(begin);
    smaller.faults.erase(first, first + static_cast<ptrdiff_t>(size));
    return smaller;
  };
  for (int less = plan.steps / 2; less > 0; less /= 2) {
    while (plan.steps > less) {
      Plan shorter = plan;
      shorter.steps -= less;
      if (!take(shorter)) break;
    }
  }
  std::erase_if(plan.faults, [&](const Fault& fault) { return fault.step >= plan.steps; });
  for (size_t size = plan.faults.size(); size > 0; size /= 2) {
    for (size_t begin = 0; begin + size <= plan.faults.size();) {
      if (!take(without(begin, size))) begin += size;
    }
  }
  return plan;
}

std::string Describe(const Plan& plan) {
  constexpr const char* kNames[Fault::kKinds] = {"reset",     "cut",      "black hole", "kill",
                                                 "take-over", "delay",    "deny",       "sleep",
                                                 "busy",      "intruder", "firewall"};
  std::ostringstream text;
  text << "seed " << plan.seed << ", " << plan.steps << " steps";
  for (const Fault& fault : plan.faults) {
    text << ", " << kNames[static_cast<int>(fault.kind)] << " (" << fault.random << ") before step "
         << fault.step;
  }
  return text.str();
}

class SimulatorTest : public ::testing::TestWithParam<Kind> {};

TEST_P(SimulatorTest, NothingIsLostOrDoubled) {
  const uint64_t wanted = Argument("--events=", 60'000);
  const uint64_t first = Argument("--seed=", 0);
  uint64_t events = 0;
  uint64_t seed = first;
  for (; events < wanted; ++seed) {
    const Plan plan = MakePlan(GetParam(), seed);
    const Flight flight = Fly(GetParam(), plan);
    events += flight.events;
    EXPECT_EQ(flight.datagrams > 0, GetParam().sends_datagrams);
    if (flight.failure.empty()) continue;
    const Plan shrunk = Shrunk(GetParam(), plan);
    FAIL() << Fly(GetParam(), shrunk).failure << Describe(shrunk) << "\nof " << plan.faults.size()
           << " faults; at first " << flight.failure;
  }
  std::cout << events << " events, seeds " << first << " to " << seed - 1 << "\n";
}

INSTANTIATE_TEST_SUITE_P(
    Kinds, SimulatorTest,
    ::testing::Values(
        Kind{.is_stored = false}, Kind{.has_engine = true}, Kind{.servers = 3},
        Kind{.servers = 2, .has_engine = true, .shares_head = true}, Kind{.is_old = true},
        Kind{.is_shared = true}, Kind{.has_engine = true, .kept_steps = 5},
        Kind{.servers = 3, .sends_datagrams = true},
        Kind{.is_stored = false, .sends_datagrams = true},
        Kind{.has_engine = true, .kept_steps = 5, .sends_datagrams = true},
        Kind{.servers = 2, .has_engine = true, .shares_head = true, .sends_datagrams = true},
        Kind{.is_shared = true, .sends_datagrams = true}));

// Replays the scenario of link events in simulated time.
//
// What was found with its mend taken out of core/robot:
//
//   a robot that stands still waits for the answer to a lost datagram     "no answer, cut"
std::vector<LinkEvent> ReadEvents() {
  std::vector<LinkEvent> events;
  std::ifstream file(LINK_EVENTS);
  for (std::string line; std::getline(file, line);) {
    if (line.starts_with('#')) continue;
    LinkEvent event;
    std::string kinds, end;
    std::istringstream words(line);
    words >> kinds >> event.steps >> event.source >> end;
    event.ends = end == "end";
    std::istringstream names(kinds);
    for (std::string kind; std::getline(names, kind, '+');) event.kinds.push_back(kind);
    events.push_back(event);
  }
  return events;
}

TEST(ScenarioTest, EachEventHasItsSourcesAndCostsNothing) {
  const std::vector<LinkEvent> events = ReadEvents();
  ASSERT_EQ(events.size(), 40);
  const Flight flight = Replay(events);
  EXPECT_EQ(flight.failure, "");
  EXPECT_GT(flight.datagrams, 0);
}

}  // namespace
}  // namespace spikeserve::robot
