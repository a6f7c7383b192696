#include "server/process_metrics.h"

#include <sys/resource.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>
#include <string>
#include <system_error>
#include <vector>

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

// Seconds since the epoch at which the machine started, or 0.
double BootSeconds() {
  std::ifstream stat("/proc/stat");
  for (std::string word; stat >> word;) {
    double seconds = 0;
    if (word == "btime" && stat >> seconds) return seconds;
    stat.ignore(std::numeric_limits<std::streamsize>::max(), '\n');
  }
  return 0;
}

// The fields of proc(5)'s /proc/self/stat by their numbers there, 4 to 24; empty where it cannot be
// read.
std::vector<double> ReadStat() {
  std::ifstream file("/proc/self/stat");
  // Field 2 is the program's name in parentheses and may hold spaces; field 3 is a letter.
  file.ignore(std::numeric_limits<std::streamsize>::max(), ')');
  char state = 0;
  file >> state;
  std::vector<double> fields(25);
  for (size_t i = 4; i < fields.size(); ++i) file >> fields[i];
  return file ? fields : std::vector<double>();
}

}  // namespace

std::vector<MetricFamily> CollectProcessMetrics() {
  std::vector<MetricFamily> families;
  const auto add = [&](const char* name, const char* help, MetricType type, double value) {
    families.push_back(Family(name, help, type, value));
  };
  if (const auto stat = ReadStat(); !stat.empty()) {
    const double user_ticks = stat[14], system_ticks = stat[15], start_ticks = stat[22];
    const double resident_pages = stat[24];
    const auto ticks_per_second = static_cast<double>(sysconf(_SC_CLK_TCK));
    add("process_cpu_seconds_total", "User and system CPU time spent.", MetricType::Counter,
        (user_ticks + system_ticks) / ticks_per_second);
    add("process_resident_memory_bytes", "Resident memory.", MetricType::Gauge,
        resident_pages * static_cast<double>(sysconf(_SC_PAGESIZE)));
    add("process_start_time_seconds", "When the process started, since the Unix epoch.",
        MetricType::Gauge, BootSeconds() + start_ticks / ticks_per_second);
  }
  std::error_code error;
  const auto open = std::filesystem::directory_iterator("/proc/self/fd", error);
  if (!error) {
    add("process_open_fds", "Open file descriptors.", MetricType::Gauge,
        static_cast<double>(std::distance(begin(open), end(open))));
  }
  if (rlimit limit; getrlimit(RLIMIT_NOFILE, &limit) == 0) {
    add("process_max_fds", "File descriptors that may be open.", MetricType::Gauge,
        static_cast<double>(limit.rlim_cur));
  }
  return families;
}

}  // namespace spikeserve
