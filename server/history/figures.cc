#include "server/history/figures.h"

#include <algorithm>
#include <limits>
#include <set>

#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

constexpr char kCalls[] = "spikeserve_rpc_duration_seconds";

// Returns NaN, which is null in JSON, for a division by zero.
double Ratio(double a, double b) {
  return b > 0.0 ? a / b : std::numeric_limits<double>::quiet_NaN();
}

Json Quantiles(const Distribution& distribution) {
  return {{"p50", Quantile(distribution, 0.5)},
          {"p90", Quantile(distribution, 0.9)},
          {"p99", Quantile(distribution, 0.99)},
          {"p999", Quantile(distribution, 0.999)}};
}

// Returns the series of a family by the values of one label.
std::map<std::string, Selection> By(const char* label, const Selection& all) {
  std::map<std::string, Selection> by;
  for (const MetricSeries* series : all) {
    const auto found = series->labels.find(label);
    if (found != series->labels.end()) by[found->second].push_back(series);
  }
  return by;
}

}  // namespace

bool IsAgentMistake(const std::string& code) {
  return code == "INVALID_ARGUMENT" || code == "NOT_FOUND" || code == "FAILED_PRECONDITION";
}

bool IsServerError(const std::string& code) {
  return code != "OK" && code != "CANCELLED" && !IsAgentMistake(code);
}

Selection SelectCalls(const MetricHistory& history,
                      bool (*wanted)(const std::string& method, const std::string& code)) {
  Selection calls = history.Select(kCalls);
  std::erase_if(calls, [&](const MetricSeries* series) {
    return !wanted(series->labels.at("method"), series->labels.at("code"));
  });
  return calls;
}

FigureSource::FigureSource(const MetricHistory& history, const MetricLabels& labels)
    : history_(history),
      is_server_(labels.empty()),
      decisions_(history.Select("spikeserve_decisions_total", labels)),
      spikes_(history.Select("spikeserve_spikes_total", labels)),
      durations_(history.Select("spikeserve_decision_duration_seconds", labels)),
      returns_(history.Select("spikeserve_episode_return", labels)),
      sessions_(history.Select("spikeserve_sessions", labels)),
      errors_(history.Select("spikeserve_policy_errors_total", labels)),
      unusual_(history.Select("spikeserve_unusual_observations_total", labels)),
      drift_(history.Select("spikeserve_head_drift_ratio", labels)),
      updates_(history.Select("spikeserve_learning_updates_total", labels)),
      held_out_(history.Select("spikeserve_head_held_out_sessions", labels)),
      trimmed_(history.Select("spikeserve_head_trimmed_contributions", labels)),
      spikes_by_stage_(By("stage", spikes_)),
      energy_by_model_(
          By("energy_model", history.Select("spikeserve_energy_joules_total", labels))) {
  if (!is_server_) {
    dense_energy_by_model_ =
        By("energy_model", history.Select("spikeserve_dense_energy_joules", labels));
    return;
  }
  calls_ = history.Select(kCalls);
  acts_ = SelectCalls(history, [](const std::string& method, const std::string& /*code*/) {
    return method == "Act" || method == "ActStream";
  });
  failed_ = SelectCalls(history, [](const std::string& /*method*/, const std::string& code) {
    return IsServerError(code);
  });
  refused_ = SelectCalls(history, [](const std::string& /*method*/, const std::string& code) {
    return IsAgentMistake(code);
  });
}

Json FigureSource::Energy(const char* unit, TimeSpan span, double divisor) const {
  Json energy = Json::object();
  for (const auto& [model, series] : energy_by_model_) {
    energy[model] = Ratio(Increase(series, span), divisor);
  }
  return {{unit, std::move(energy)}};
}

void FigureSource::AddMain(TimeSpan span, Json* figures) const {
  const double seconds = absl::ToDoubleSeconds(span.to - std::max(span.from, history_.start()));
  const double decisions = Increase(decisions_, span);
  const Distribution returns = Observed(returns_, span);
  const Distribution durations = Observed(durations_, span);
  (*figures)["sessions"] = GaugeAt(sessions_, span.to);
  (*figures)["decisions_per_second"] = Ratio(decisions, seconds);
  (*figures)["spikes_per_decision"] = Ratio(Increase(spikes_, span), decisions);
  (*figures)["return_mean"] = Ratio(returns.sum, returns.count);
  (*figures)["decision_p99_seconds"] = Quantile(durations, 0.99);
  figures->update(Energy("energy_joules_per_second", span, seconds));
  if (!is_server_) return;
  const double calls = Observed(calls_, span).count;
  (*figures)["call_p99_seconds"] = Quantile(Observed(acts_, span), 0.99);
  (*figures)["failed_ratio"] = Ratio(Observed(failed_, span).count, calls);
  (*figures)["refused_ratio"] = Ratio(Observed(refused_, span).count, calls);
}

Json FigureSource::Figures(TimeSpan span) const {
  Json figures = Json::object();
  AddMain(span, &figures);
  const double seconds = absl::ToDoubleSeconds(span.to - std::max(span.from, history_.start()));
  const double decisions = Increase(decisions_, span);
  const Distribution returns = Observed(returns_, span);
  figures["decisions"] = decisions;
  figures["decision_seconds"] = Quantiles(Observed(durations_, span));
  figures["errors_per_second"] = Ratio(Increase(errors_, span), seconds);
  figures["unusual_per_decision"] = Ratio(Increase(unusual_, span), decisions);
  figures["episodes"] = returns.count;
  figures["return_p10"] = Quantile(returns, 0.1);
  figures["return_median"] = Quantile(returns, 0.5);
  Json& stages = figures["spikes_by_stage"] = Json::object();
  for (const auto& [stage, spikes] : spikes_by_stage_) {
    stages[stage] = Ratio(Increase(spikes, span), decisions);
  }
  figures.update(Energy("energy_joules_per_decision", span, decisions));
  figures.update(Energy("energy_joules", span, 1.0));
  if (!is_server_) {
    Json& dense = figures["dense_energy_joules_per_decision"] = Json::object();
    for (const auto& [model, series] : dense_energy_by_model_) dense[model] = Gauge(series);
    figures["head_drift"] = Gauge(drift_);
    figures["head_updates_per_second"] = Ratio(Increase(updates_, span), seconds);
    figures["held_out_sessions"] = Gauge(held_out_);
    figures["trimmed_contributions"] = Gauge(trimmed_);
  } else {
    figures["calls_per_second"] = Ratio(Observed(calls_, span).count, seconds);
    figures["sessions_limit"] = Gauge(history_.Select("spikeserve_sessions_limit"));
  }
  return figures;
}

Json FigureSource::Series(const std::vector<absl::Duration>& times) const {
  Json lists = Json::object();
  AddMain({.from = history_.end(), .to = history_.end()}, &lists);  // for the names of the figures
  for (auto& [name, value] : lists.items()) {
    if (!value.is_object()) {
      value = Json::array();
      continue;
    }
    for (auto& [key, number] : value.items()) number = Json::array();
  }
  for (size_t i = 1; i < times.size(); ++i) {
    Json figures = Json::object();
    AddMain({.from = times[i - 1], .to = times[i]}, &figures);
    for (auto& [name, value] : figures.items()) {
      if (!value.is_object()) {
        lists[name].push_back(std::move(value));
        continue;
      }
      for (auto& [key, number] : value.items()) lists[name][key].push_back(std::move(number));
    }
  }
  return lists;
}

bool FigureSource::IsIdle(TimeSpan span) const {
  return Increase(decisions_, span) == 0.0 && Observed(returns_, span).count == 0.0 &&
         Increase(errors_, span) == 0.0 && GaugeAt(sessions_, span.to) == 0.0;
}

Json CallFigures(const MetricHistory& history, TimeSpan span) {
  const double seconds = absl::ToDoubleSeconds(span.to - std::max(span.from, history.start()));
  Json list = Json::array();
  for (const auto& [method, calls] : By("method", history.Select(kCalls))) {
    const Distribution all = Observed(calls, span);
    Json by_code = Json::object();
    for (const auto& [code, some] : By("code", calls)) {
      if (code != "OK") by_code[code] = Ratio(Observed(some, span).count, seconds);
    }
    list.push_back({{"method", method},
                    {"calls_per_second", Ratio(all.count, seconds)},
                    {"errors_per_second", std::move(by_code)},
                    {"seconds", Quantiles(all)}});
  }
  return list;
}

}  // namespace spikeserve
