#include "server/metrics/robot_metrics.h"

#include "server/metrics/gauge_family.h"

namespace spikeserve {

std::vector<prometheus::MetricFamily> CollectRobots(SessionStore& store) {
  int64_t robots = 0;
  int64_t silent = 0;
  store.ForEach([](const SessionEntry& entry) { return entry.period > absl::ZeroDuration(); },
                [&](const ListedSession& listed) {
                  ++robots;
                  silent += IsSilent(listed.entry->period, listed.idle) ? 1 : 0;
                });
  std::vector<prometheus::MetricFamily> families = {
      GaugeFamily("spikeserve_robots", "Open sessions whose robot has declared its period."),
      GaugeFamily(
          "spikeserve_silent_robots",
          "Those of spikeserve_robots that have sent nothing for longer than 50 periods and "
          "2 seconds.")};
  AddGauge(families[0], {}, static_cast<double>(robots));
  AddGauge(families[1], {}, static_cast<double>(silent));
  return families;
}

}  // namespace spikeserve
