#include "server/transport/connection_metrics.h"

#include <string>
#include <utility>

#include "server/metrics/gauge_family.h"

namespace spikeserve {
namespace {

using prometheus::ClientMetric;
using prometheus::MetricFamily;

MetricFamily ByLimit(const char* name, const char* help,
                     const ConnectionTable::CountByLimit& counts) {
  MetricFamily family = {
      .name = name, .help = help, .type = prometheus::MetricType::Counter, .metric = {}};
  for (size_t i = 0; i < counts.size(); ++i) {
    ClientMetric metric;
    metric.label = {{"limit", std::string(ToString(static_cast<ConnectionLimit>(i)))}};
    metric.counter.value = static_cast<double>(counts[i]);
    family.metric.push_back(std::move(metric));
  }
  return family;
}

}  // namespace

std::vector<MetricFamily> CollectConnections(const Transport& transport) {
  const ConnectionTable::Counts counts = transport.connections().counts();
  MetricFamily open =
      GaugeFamily("spikeserve_connections",
                  "Open connections of gRPC. Unauthenticated: none of its calls was admitted yet.");
  AddGauge(open, {{"state", "known"}}, static_cast<double>(counts.open - counts.unauthenticated));
  AddGauge(open, {{"state", "unauthenticated"}}, static_cast<double>(counts.unauthenticated));
  MetricFamily limit =
      GaugeFamily("spikeserve_connections_limit", "Limit on the open connections of gRPC.");
  AddGauge(limit, {}, static_cast<double>(transport.connections().max_connections()));
  MetricFamily bytes = GaugeFamily(
      "spikeserve_bytes_in_flight",
      "Memory of requests and answers in flight: of the calls of all callers, and of the "
      "unauthenticated connections and calls.");
  AddGauge(bytes, {{"of", "all"}}, static_cast<double>(transport.budgets().all.used()));
  AddGauge(bytes, {{"of", "unauthenticated"}},
           static_cast<double>(transport.budgets().unauthenticated.used()));
  return {std::move(open), std::move(limit), std::move(bytes),
          ByLimit("spikeserve_connections_refused_total",
                  "New connections that were refused, by the limit that they met.", counts.refused),
          ByLimit("spikeserve_connections_dropped_total",
                  "Unauthenticated connections that were closed to make room for others, by limit.",
                  counts.dropped)};
}

}  // namespace spikeserve
