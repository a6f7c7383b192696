// Replays the scenario of link events in simulated time.
//
// What was found with its mend taken out of core/robot:
//
//   a robot that stands still waits for the answer to a lost datagram     "no answer, cut"
#include <gtest/gtest.h>

#include <fstream>
#include <sstream>

#include "tests/unit/robot/simulator.h"

namespace spikeserve::robot {
namespace {

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
