#include "server/usage/usage_rows.h"

#include <cmath>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_split.h"

namespace spikeserve {
namespace {

constexpr char kEnd = '\xff';  // not in UTF-8
constexpr char kOther[] = "other";
constexpr size_t kMostName = 150;  // bytes, so that a key of LMDB holds all parts

constexpr absl::Duration kAfterHour = absl::Minutes(5);
constexpr absl::Duration kHoursKept = absl::Hours(24 * 35);
constexpr int kMonthsOfDays = 13;

// Returns the first kMostName bytes at most, without half a character of UTF-8.
absl::string_view Shorten(absl::string_view name) {
  if (name.size() <= kMostName) return name;
  size_t size = kMostName;
  while (size > 0 && (static_cast<uint8_t>(name[size]) & 0xc0) == 0x80) --size;
  return name.substr(0, size);
}

absl::CivilHour CivilOf(int64_t hour) {
  return absl::ToCivilHour(absl::UnixEpoch() + absl::Hours(hour), absl::UTCTimeZone());
}

template <typename Civil>
absl::Time Start(Civil civil) {
  return absl::FromCivil(civil, absl::UTCTimeZone());
}

template <typename Civil>
int64_t HourOf(Civil civil) {
  return absl::ToInt64Hours(Start(civil) - absl::UnixEpoch());
}

}  // namespace

std::string UsageSeries::ToKey() const {
  const absl::string_view end(&kEnd, 1);
  return absl::StrCat(Shorten(tenant), end, Shorten(policy), end, version, end, Shorten(label));
}

UsageSeries UsageSeries::FromKey(absl::string_view key) {
  const std::vector<std::string> parts = absl::StrSplit(key, absl::MaxSplits(kEnd, 3));
  UsageSeries series = {.tenant = parts[0]};
  if (parts.size() != 4) return series;
  series.policy = parts[1];
  series.version = 0;
  if (!absl::SimpleAtoi(parts[2], &series.version)) series.version = 0;
  series.label = parts[3];
  return series;
}

UsageSeries SeriesOf(const SessionOptions& options, const std::string& label) {
  const auto found = label.empty() ? options.labels.end() : options.labels.find(label);
  return {.tenant = options.tenant,
          .policy = options.policy,
          .version = options.version,
          .label = found == options.labels.end() ? "" : found->second};
}

std::string OtherSeries(absl::string_view key) {
  return UsageSeries{.tenant = UsageSeries::FromKey(key).tenant, .policy = kOther, .label = kOther}
      .ToKey();
}

std::string FormatCounts(const UsageCounts& counts) {
  std::string text;
  for (const double value : counts.values) absl::StrAppendFormat(&text, "%.17g ", value);
  return text;
}

UsageCounts ParseCounts(absl::string_view text) {
  UsageCounts counts;
  size_t i = 0;
  for (const absl::string_view number : absl::StrSplit(text, ' ', absl::SkipEmpty())) {
    double value = 0.0;
    if (i < kUsageFields && absl::SimpleAtod(number, &value) && std::isfinite(value)) {
      counts.values[i] = value;
    }
    ++i;
  }
  return counts;
}

std::string OpenPart(absl::Time time) {
  return absl::FormatTime("o%Y%m%d%H", time, absl::UTCTimeZone());
}

std::optional<std::pair<absl::Time, absl::Time>> SpanOf(absl::string_view part) {
  const std::string digits(part.empty() ? part : part.substr(1));
  int64_t number = 0;
  if (!absl::SimpleAtoi(digits, &number) || number < 0) return std::nullopt;
  const auto span = [](auto civil) {
    return std::make_optional(std::pair(Start(civil), Start(civil + 1)));
  };
  if (part[0] == 'o' && digits.size() == 10) {
    return span(absl::CivilHour(number / 1'000'000, static_cast<int>(number / 10'000 % 100),
                                static_cast<int>(number / 100 % 100),
                                static_cast<int>(number % 100)));
  }
  if (part[0] == 'h' && digits.size() == 8) {
    return span(absl::CivilDay(number / 10'000, static_cast<int>(number / 100 % 100),
                               static_cast<int>(number % 100)));
  }
  if (part[0] == 'd' && digits.size() == 6) {
    return span(absl::CivilMonth(number / 100, static_cast<int>(number % 100)));
  }
  if (part[0] == 'm' && digits.size() == 4) return span(absl::CivilYear(number));
  return std::nullopt;
}

std::optional<std::string> TargetOf(absl::string_view part, absl::Time now) {
  const auto span = SpanOf(part);
  if (!span.has_value()) return std::nullopt;
  const auto [begin, end] = *span;
  const auto named = [begin = begin](const char* format) {
    return absl::FormatTime(format, begin, absl::UTCTimeZone());
  };
  if (part[0] == 'o' && now >= end + kAfterHour) return named("h%Y%m%d");
  if (part[0] == 'h' && now >= end + kHoursKept) return named("d%Y%m");
  const auto month = absl::ToCivilMonth(end, absl::UTCTimeZone());
  if (part[0] == 'd' && now >= Start(month + kMonthsOfDays)) return named("m%Y");
  return std::nullopt;
}

int64_t Truncate(absl::string_view target, int64_t hour) {
  if (target[0] == 'd') return HourOf(absl::CivilDay(CivilOf(hour)));
  if (target[0] == 'm') return HourOf(absl::CivilMonth(CivilOf(hour)));
  return hour;
}

void Merge(absl::string_view target, const std::vector<UsageRow>& more, UsageRows* rows) {
  std::map<int64_t, size_t> series;  // by the first hour of a row
  for (const auto& [key, counts] : *rows) ++series[key.second];
  for (const UsageRow& row : more) {
    const int64_t hour = Truncate(target, row.hour);
    auto found = rows->find({row.series, hour});
    if (found == rows->end()) {
      const bool fits = series[hour] < kMostSeries;
      const auto [added, is_new] =
          rows->try_emplace({fits ? row.series : OtherSeries(row.series), hour});
      if (is_new) ++series[hour];
      found = added;
    }
    found->second += row.counts;
  }
}

}  // namespace spikeserve
