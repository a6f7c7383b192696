#include "server/history/server_history.h"

#include <algorithm>
#include <iterator>
#include <string>

#include "absl/strings/str_cat.h"
#include "absl/time/clock.h"
#include "server/history/figures.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

// Adds {"policy", "version"} to the figures of a version. As in messages, the version is a string.
Json Named(const MetricLabels& version, Json figures) {
  figures["policy"] = version.at("policy");
  figures["version"] = version.at("version");
  return figures;
}

}  // namespace

ServerHistory::ServerHistory(Collect collect, const Clock* clock)
    : collect_(std::move(collect)), clock_(clock) {
  Tick();
}

void ServerHistory::Tick() {
  const auto families = collect_();
  absl::MutexLock lock(&mutex_);
  const absl::Duration now = clock_->Now();
  history_.Add(families, now);
  ticks_.push_back(now);
  ++tick_count_;
  while (ticks_.front() < now - kLongest - kInterval) ticks_.pop_front();
  alerts_.Evaluate(history_, now, absl::ToUnixMillis(absl::Now()) / 1000.0);
}

std::vector<MetricLabels> ServerHistory::Versions() const {
  std::vector<MetricLabels> versions;
  for (const MetricSeries* series : history_.Select("spikeserve_policy_info")) {
    if (!series->present) continue;
    versions.push_back(
        {{"policy", series->labels.at("policy")}, {"version", series->labels.at("version")}});
  }
  return versions;
}

absl::Duration ServerHistory::TickBefore(absl::Duration time) const {
  if (time < ticks_.front()) return std::max(time, history_.start());
  return *std::prev(std::upper_bound(ticks_.begin(), ticks_.end(), time));
}

Json ServerHistory::Status(absl::Duration window) const {
  absl::MutexLock lock(&mutex_);
  const TimeSpan span = {.from = TickBefore(history_.end() - window), .to = history_.end()};
  Json versions = Json::array();
  for (const MetricLabels& labels : Versions()) {
    versions.push_back(Named(labels, FigureSource(history_, labels).Figures(span)));
  }
  return {{"window_seconds", absl::ToDoubleSeconds(span.to - span.from)},
          {"figures", FigureSource(history_, {}).Figures(span)},
          {"versions", std::move(versions)},
          {"calls", CallFigures(history_, span)},
          {"alerts", alerts_.ToJson()}};
}

Json ServerHistory::Summary() const {
  absl::MutexLock lock(&mutex_);
  const TimeSpan span = {.from = TickBefore(history_.end() - absl::Minutes(1)),
                         .to = history_.end()};
  const Json figures = FigureSource(history_, {}).Figures(span);
  Json summary = Json::object();
  for (const char* name :
       {"sessions", "decisions_per_second", "call_p99_seconds", "failed_ratio"}) {
    summary[name] = figures.at(name);
  }
  Json& playing = summary["playing"] = Json::array();
  for (const MetricLabels& labels : Versions()) {
    if (playing.size() == kMostPlaying) break;
    if (FigureSource(history_, labels).IsIdle(span)) continue;
    playing.push_back(absl::StrCat(labels.at("policy"), "/", labels.at("version")));
  }
  int firing = 0;
  for (const Json& alert : alerts_.ToJson()) firing += alert.at("state") == "firing";
  summary["alerts_firing"] = firing;
  return summary;
}

Json ServerHistory::Over(absl::Duration seconds) const {
  absl::MutexLock lock(&mutex_);
  // Each point covers this many ticks. Points begin at multiples of it, so that they stay the same
  // from one call to the next.
  const int64_t step = std::max<int64_t>(
      1, absl::ToInt64Seconds(seconds / kPoints) / absl::ToInt64Seconds(kInterval));
  const absl::Duration oldest = history_.end() - seconds;
  const int64_t first = tick_count_ - static_cast<int64_t>(ticks_.size());
  std::vector<absl::Duration> times;
  for (size_t i = 0; i < ticks_.size(); ++i) {
    const bool begins = (first + static_cast<int64_t>(i)) % step == 0;
    if (begins && ticks_[i] >= oldest) times.push_back(ticks_[i]);
  }
  Json ago = Json::array();
  for (size_t i = 1; i < times.size(); ++i) {
    ago.push_back(absl::ToDoubleSeconds(history_.end() - times[i]));
  }
  Json versions = Json::array();
  for (const MetricLabels& labels : Versions()) {
    const FigureSource source(history_, labels);
    if (source.IsIdle({.from = oldest, .to = history_.end()})) continue;
    versions.push_back(Named(labels, source.Series(times)));
  }
  return {{"step_seconds", static_cast<double>(step) * absl::ToDoubleSeconds(kInterval)},
          {"seconds_ago", std::move(ago)},
          {"server", FigureSource(history_, {}).Series(times)},
          {"versions", std::move(versions)}};
}

}  // namespace spikeserve
