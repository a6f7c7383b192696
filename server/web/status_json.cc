#include "server/web/status_json.h"

#include <utility>

#include "absl/time/time.h"
#include "core/base/version.h"
#include "core/engine/energy.h"
#include "nlohmann/json.hpp"
#include "prometheus/metric_type.h"
#include "proto/json.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

Json SeriesToJson(const prometheus::ClientMetric& metric, prometheus::MetricType type) {
  Json series = {{"labels", Json::object()}};
  for (const auto& label : metric.label) series["labels"][label.name] = label.value;
  switch (type) {
    case prometheus::MetricType::Counter:
      series["value"] = metric.counter.value;
      break;
    case prometheus::MetricType::Gauge:
      series["value"] = metric.gauge.value;
      break;
    case prometheus::MetricType::Histogram:
      series["count"] = metric.histogram.sample_count;
      series["sum"] = metric.histogram.sample_sum;
      series["buckets"] = Json::array();
      for (const auto& bucket : metric.histogram.bucket) {
        // The library writes an infinite bound as null.
        series["buckets"].push_back({bucket.upper_bound, bucket.cumulative_count});
      }
      break;
    default:  // the server exports no other types
      break;
  }
  return series;
}

Json EnergyModelToJson(EnergyModel model) {
  const EnergyModelInfo& info = InfoOf(model);
  return {
      {"name", std::string(ToString(model))},       {"default", model == kDefaultEnergyModel},
      {"counts", std::string(info.counts)},         {"leaves_out", std::string(info.leaves_out)},
      {"applies_to", std::string(info.applies_to)}, {"source", std::string(info.source)}};
}

// What each energy model counts and leaves out. The figures without a model's name, such as
// energy_joules, are those of the default one, which applies to every policy.
Json EnergyModelsToJson() {
  Json models = Json::array();
  for (const auto& [model, name] : EnumNames(EnergyModel())) {
    models.push_back(EnergyModelToJson(model));
  }
  return models;
}

// Returns the reports of the servers. Leaves out what is no report: anybody who can write to the
// store may have written it.
Json ServersToJson(const ServerStatus& server) {
  Json servers = Json::array();
  for (const ReplicaReport& report : server.reports) {
    Json row = Json::parse(report.json, nullptr, /*allow_exceptions=*/false);
    if (!row.is_object()) continue;
    row["replica"] = report.replica;
    row["seconds_ago"] = server.time - absl::ToDoubleSeconds(report.written);
    servers.push_back(std::move(row));
  }
  return servers;
}

}  // namespace

std::string StatusJson(Json figures, const std::vector<prometheus::MetricFamily>& families,
                       const v1::ListPoliciesResponse& policies,
                       const v1::ListRolloutsResponse& rollouts, const ServerStatus& server) {
  Json status = std::move(figures);
  status["time"] = server.time;
  status["version"] = std::string(Version());
  status["serving"] = server.serving;
  status["store"] = server.store;
  status["replica"] = server.replica;
  status["replicas"] = server.replicas;
  status["servers"] = ServersToJson(server);
  status["policies"] = MessagesToList(policies.policies());
  status["rollouts"] = MessagesToList(rollouts.rollouts());
  status["energy_models"] = EnergyModelsToJson();
  status["metrics"] = Json::object();
  for (const prometheus::MetricFamily& family : families) {
    Json& series = status["metrics"][family.name] = Json::array();
    for (const auto& metric : family.metric) series.push_back(SeriesToJson(metric, family.type));
  }
  // The name of a server in the store may be any bytes.
  return status.dump(-1, ' ', /*ensure_ascii=*/false, Json::error_handler_t::replace);
}

std::string ServerReport(Json summary, const std::string& address, bool serving) {
  summary["address"] = address;
  summary["version"] = std::string(Version());
  summary["serving"] = serving;
  return summary.dump();
}

std::string ErrorJson(const absl::Status& status) {
  return Json{{"code", absl::StatusCodeToString(status.code())},
              {"message", std::string(status.message())}}
      .dump(-1, ' ', false, Json::error_handler_t::replace);
}

}  // namespace spikeserve
