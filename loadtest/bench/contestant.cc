#include "loadtest/bench/contestant.h"

#include <ctime>
#include <iostream>
#include <string>

namespace spikeserve {
namespace {

double ProcessorSeconds() {
  timespec time;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
  return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

// Reading the processor time is a system call, which takes a tenth of the fastest decision.
constexpr int kCallsPerReading = 16;

}  // namespace

void RunContestant(const std::function<Work()>& decide) {
  std::cout << "ready" << std::endl;
  for (std::string line; std::getline(std::cin, line);) {
    const double duration = std::stod(line);
    Work total;
    const double start = ProcessorSeconds();
    double now = start;
    for (; now - start < duration; now = ProcessorSeconds()) {
      for (int call = 0; call < kCallsPerReading; ++call) {
        const Work work = decide();
        total.decisions += work.decisions;
        total.spikes += work.spikes;
      }
    }
    std::cout << "{\"decisions\": " << total.decisions << ", \"seconds\": " << now - start
              << ", \"spikes\": " << total.spikes << "}" << std::endl;
  }
}

}  // namespace spikeserve
