// Builds families of gauges whose values are computed when the metrics are read.
#ifndef SERVER_METRICS_GAUGE_FAMILY_H_
#define SERVER_METRICS_GAUGE_FAMILY_H_

#include <utility>
#include <vector>

#include "prometheus/client_metric.h"
#include "prometheus/metric_family.h"

namespace spikeserve {

inline prometheus::MetricFamily GaugeFamily(const char* name, const char* help) {
  return {.name = name, .help = help, .type = prometheus::MetricType::Gauge, .metric = {}};
}

inline void AddGauge(prometheus::MetricFamily& family,
                     std::vector<prometheus::ClientMetric::Label> labels, double value) {
  prometheus::ClientMetric metric;
  metric.label = std::move(labels);
  metric.gauge.value = value;
  family.metric.push_back(std::move(metric));
}

}  // namespace spikeserve

#endif  // SERVER_METRICS_GAUGE_FAMILY_H_
