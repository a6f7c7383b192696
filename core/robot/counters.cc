#include "core/robot/counters.h"

#include <algorithm>
#include <cmath>

namespace spikeserve::robot {
namespace {

constexpr Time kFirst = std::chrono::microseconds(10);  // shorter ages count as this one
constexpr double kGrowth = 1.02;                        // from one bucket to the next
constexpr double kMiddle = 1.00995049383620779;         // sqrt(kGrowth)
constexpr Time kReportEvery = std::chrono::seconds(1);

// Returns the nanoseconds at which each bucket begins.
constexpr auto kBegins = [] {
  std::array<double, Ages::kBuckets> begins = {};
  double begin = static_cast<double>(kFirst.count());
  for (double& each : begins) {
    each = begin;
    begin *= kGrowth;
  }
  return begins;
}();

}  // namespace

std::string_view SourceName(Source source) {
  constexpr std::array<std::string_view, kSources> kNames = {"fresh", "held", "local", "safe"};
  return kNames[static_cast<size_t>(source)];
}

void Ages::Add(Time age) {
  const auto behind =
      std::upper_bound(kBegins.begin() + 1, kBegins.end(), static_cast<double>(age.count()));
  ++counts_[static_cast<size_t>(behind - kBegins.begin() - 1)];
  ++total_;
}

Time Ages::Quantile(double share) const {
  double left = std::ceil(share * static_cast<double>(total_));
  for (size_t i = 0; i < counts_.size(); ++i) {
    left -= static_cast<double>(counts_[i]);
    if (counts_[i] > 0 && left <= 0.0) {
      return Time(static_cast<int64_t>(kBegins[i] * kMiddle));
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
