#include "core/robot/counters.h"

#include <algorithm>
#include <cmath>

namespace spikeserve::robot {
namespace {

constexpr Time kFirst = std::chrono::microseconds(10);  // shorter ages count as this one
constexpr double kGrowth = 1.02;                        // from one bucket to the next
constexpr Time kReportEvery = std::chrono::seconds(1);

}  // namespace

std::string_view SourceName(Source source) {
  constexpr std::array<std::string_view, kSources> kNames = {"fresh", "held", "local", "safe"};
  return kNames[static_cast<size_t>(source)];
}

void Ages::Add(Time age) {
  double bucket = 0.0;
  if (age > kFirst) {
    const double ratio = static_cast<double>(age.count()) / static_cast<double>(kFirst.count());
    bucket = std::log(ratio) / std::log(kGrowth);
  }
  const double last = static_cast<double>(counts_.size() - 1);
  ++counts_[static_cast<size_t>(std::min(bucket, last))];
  ++total_;
}

Time Ages::Quantile(double share) const {
  double left = std::ceil(share * static_cast<double>(total_));
  for (size_t i = 0; i < counts_.size(); ++i) {
    left -= static_cast<double>(counts_[i]);
    if (counts_[i] > 0 && left <= 0.0) {
      const double ratio = std::pow(kGrowth, static_cast<double>(i) + 0.5);
      return Time(static_cast<int64_t>(ratio * static_cast<double>(kFirst.count())));
    }
  }
  return Time::zero();
}

void Counters::CountStep(Source source, Time age, Time now) {
  ++counts_.steps;
  ++counts_.by_source[static_cast<size_t>(source)];
  if (source != Source::kSafe) ages_.Add(age);
  oldest_age_ = std::max(oldest_age_, age);
  const Time gap = now - fresh_at_;
  counts_.longest_gap = std::max(counts_.longest_gap, gap);
  reported_gap_ = std::max(reported_gap_, gap);
  if (source == Source::kFresh) fresh_at_ = now;
}

bool Counters::IsReportDue(Time now) const { return now - reported_at_ >= kReportEvery; }

std::optional<Report> Counters::TakeReport(Time now) {
  if (!IsReportDue(now)) return std::nullopt;
  const Report report = {&counts_, reported_gap_, oldest_age_};
  reported_at_ = now;
  reported_gap_ = oldest_age_ = Time::zero();
  return report;
}

}  // namespace spikeserve::robot
