#include "client/src/pilot/counters.h"

#include <algorithm>
#include <cmath>

namespace spikeserve {

absl::string_view ActionSourceName(ActionSource source) {
  switch (source) {
    case ActionSource::kFresh:
      return "fresh";
    case ActionSource::kHeld:
      return "held";
    case ActionSource::kLocal:
      return "local";
    case ActionSource::kSafe:
      return "safe";
  }
  return "";  // unreachable: the switch handles every source
}

namespace piloting {
namespace {

constexpr absl::Duration kFirst = absl::Microseconds(10);  // shorter ages count as this one
constexpr double kGrowth = 1.02;                           // from one bucket to the next
constexpr absl::Duration kReportEvery = absl::Seconds(1);

}  // namespace

void Ages::Add(absl::Duration age) {
  double bucket = 0.0;
  if (age > kFirst) bucket = std::log(absl::FDivDuration(age, kFirst)) / std::log(kGrowth);
  const double last = static_cast<double>(counts_.size() - 1);
  ++counts_[static_cast<size_t>(std::min(bucket, last))];
  ++total_;
}

absl::Duration Ages::Quantile(double share) const {
  double left = std::ceil(share * static_cast<double>(total_));
  for (size_t i = 0; i < counts_.size(); ++i) {
    left -= static_cast<double>(counts_[i]);
    if (counts_[i] > 0 && left <= 0.0) {
      return kFirst * std::pow(kGrowth, static_cast<double>(i) + 0.5);
    }
  }
  return absl::ZeroDuration();
}

void Counters::CountBeat(ActionSource source, absl::Duration age, absl::Duration now) {
  ++counts_.beats;
  ++counts_.by_source[static_cast<size_t>(source)];
  if (source != ActionSource::kSafe) ages_.Add(age);
  oldest_age_ = std::max(oldest_age_, age);
  const absl::Duration gap = now - fresh_at_;
  counts_.longest_gap = std::max(counts_.longest_gap, gap);
  reported_gap_ = std::max(reported_gap_, gap);
  if (source == ActionSource::kFresh) fresh_at_ = now;
}

bool Counters::IsReportDue(absl::Duration now) const { return now - reported_at_ >= kReportEvery; }

bool Counters::FillReport(absl::Duration now, v1::BeatReport* report) {
  if (!IsReportDue(now)) return false;
  report->set_fresh(counts_.of(ActionSource::kFresh));
  report->set_held(counts_.of(ActionSource::kHeld));
  report->set_local(counts_.of(ActionSource::kLocal));
  report->set_safe(counts_.of(ActionSource::kSafe));
  report->set_late_answers(counts_.late_answers);
  report->set_cancelled_calls(counts_.cancelled_calls);
  report->set_reconnects(counts_.reconnects);
  report->set_invalid_observations(counts_.invalid_observations);
  report->set_longest_gap_seconds(absl::ToDoubleSeconds(reported_gap_));
  report->set_oldest_age_seconds(absl::ToDoubleSeconds(oldest_age_));
  reported_at_ = now;
  reported_gap_ = oldest_age_ = absl::ZeroDuration();
  return true;
}

PilotStats Counters::Snapshot() const {
  PilotStats stats = counts_;
  stats.age_p50 = ages_.Quantile(0.5);
  stats.age_p99 = ages_.Quantile(0.99);
  stats.age_p999 = ages_.Quantile(0.999);
  return stats;
}

}  // namespace piloting
}  // namespace spikeserve
