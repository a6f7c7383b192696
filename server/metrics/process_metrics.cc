#include "server/metrics/process_metrics.h"

#include <malloc.h>
#include <sys/resource.h>
#include <unistd.h>

#include <cstdint>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <limits>
#include <optional>
#include <sstream>
#include <string>
#include <system_error>
#include <vector>

#include "absl/time/time.h"
#include "prometheus/client_metric.h"
#include "prometheus/metric_type.h"

namespace spikeserve {
namespace {

using prometheus::ClientMetric;
using prometheus::MetricFamily;
using prometheus::MetricType;

MetricFamily Family(const char* name, const char* help, MetricType type, double value) {
  ClientMetric metric;
  if (type == MetricType::Counter) {
    metric.counter.value = value;
  } else {
    metric.gauge.value = value;
  }
  return {.name = name, .help = help, .type = type, .metric = {metric}};
}

// Returns the boot time of the machine in seconds since the Unix epoch, or 0 if it is unknown.
double BootSeconds() {
  std::ifstream stat("/proc/stat");
  for (std::string word; stat >> word;) {
    double seconds = 0;
    if (word == "btime" && stat >> seconds) return seconds;
    stat.ignore(std::numeric_limits<std::streamsize>::max(), '\n');
  }
  return 0;
}

// Returns field 22 of /proc/self/stat, when the process started, in ticks after the boot of the
// machine, or nothing if the file cannot be read.
std::optional<double> StartTicks() {
  std::ifstream file("/proc/self/stat");
  std::string line;
  std::getline(file, line);
  // Field 2 is the program's name in parentheses, which may contain spaces and parentheses, so
  // parsing starts after the last one. Field 3 is one letter.
  std::istringstream rest(line.substr(line.rfind(')') + 1));
  char state = 0;
  rest >> state;
  double ticks = 0;
  for (int field = 4; field <= 22; ++field) rest >> ticks;
  return rest ? std::optional(ticks) : std::nullopt;
}

// Returns the resident memory in pages, or nothing if /proc cannot be read. /proc/self/stat has it,
// too, but 0 under qemu.
std::optional<double> ResidentPages() {
  std::ifstream file("/proc/self/statm");
  double size = 0, resident = 0;
  return file >> size >> resident ? std::optional(resident) : std::nullopt;
}

// Returns the number of open file descriptors, or 0 if /proc cannot be read.
int64_t CountOpenFiles() {
  std::error_code error;
  std::filesystem::directory_iterator file("/proc/self/fd", error);
  int64_t count = 0;
  for (; !error && file != std::filesystem::directory_iterator(); file.increment(error)) ++count;
  return error ? 0 : count;
}

}  // namespace

std::vector<MetricFamily> CollectProcessMetrics() {
  std::vector<MetricFamily> families;
  const auto add = [&](const char* name, const char* help, MetricType type, double value) {
    families.push_back(Family(name, help, type, value));
  };
  if (const auto pages = ResidentPages(); pages.has_value()) {
    add("process_resident_memory_bytes", "Resident memory size.", MetricType::Gauge,
        *pages * static_cast<double>(sysconf(_SC_PAGESIZE)));
  }
  if (const auto ticks = StartTicks(); ticks.has_value()) {
    add("process_start_time_seconds", "Start time of the process since the Unix epoch.",
        MetricType::Gauge, BootSeconds() + *ticks / static_cast<double>(sysconf(_SC_CLK_TCK)));
  }
  const struct mallinfo2 heap = mallinfo2();
  add("spikeserve_allocated_bytes", "Memory that was allocated and not freed.", MetricType::Gauge,
      static_cast<double>(heap.uordblks + heap.hblkhd));
  if (timespec used; clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &used) == 0) {
    add("process_cpu_seconds_total", "User and system CPU time.", MetricType::Counter,
        absl::ToDoubleSeconds(absl::DurationFromTimespec(used)));
  }
  if (const int64_t open = CountOpenFiles(); open > 0) {
    add("process_open_fds", "Open file descriptors.", MetricType::Gauge, static_cast<double>(open));
  }
  if (rlimit limit; getrlimit(RLIMIT_NOFILE, &limit) == 0) {
    add("process_max_fds", "Limit on open file descriptors.", MetricType::Gauge,
        static_cast<double>(limit.rlim_cur));
  }
  return families;
}

}  // namespace spikeserve
