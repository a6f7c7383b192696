#include "server/usage/usage_rows.h"

#include <zlib.h>

#include <cmath>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_format.h"
#include "absl/strings/str_split.h"
#include "core/base/status_macros.h"

namespace spikeserve {
namespace {

constexpr char kEnd = '\xff';  // not in UTF-8
constexpr char kOther[] = "other";
constexpr char kVersion = 1;  // of the packed form

constexpr size_t kMostName = 150;  // bytes, so that a key of LMDB holds all parts

constexpr absl::Duration kAfterHour = absl::Minutes(5);
constexpr absl::Duration kHoursKept = absl::Hours(24 * 35);
constexpr int kMonthsOfDays = 13;

// The most bytes that a part of rows has when it is not compressed.
constexpr uint64_t kMostUnpacked = uint64_t{1} << 30;

// What is rounded away is less than one of this many parts of a unit.
double ScaleOf(size_t field) {
  switch (static_cast<UsageField>(field)) {
    case UsageField::kHorowitz45nm:
    case UsageField::kInt45nm:
    case UsageField::kIntSram45nm:
      return 1e10;
    case UsageField::kSessionSeconds:
      return 1e3;
    default:
      return 1.0;
  }
}

void PutVarint(uint64_t value, std::string* out) {
  for (; value >= 128; value >>= 7) out->push_back(static_cast<char>(value | 128));
  out->push_back(static_cast<char>(value));
}

// Small numbers of both signs become small ones.
uint64_t Zigzag(int64_t value) {
  return static_cast<uint64_t>(value) << 1 ^ static_cast<uint64_t>(value >> 63);
}
int64_t Unzigzag(uint64_t value) { return static_cast<int64_t>(value >> 1 ^ (~(value & 1) + 1)); }

class Reader {
 public:
  explicit Reader(absl::string_view bytes) : rest_(bytes) {}

  bool ok() const { return ok_; }
  bool at_end() const { return rest_.empty(); }
  uint8_t Byte() {
    if (rest_.empty()) {
      ok_ = false;
      return 0;
    }
    const auto byte = static_cast<uint8_t>(rest_[0]);
    rest_.remove_prefix(1);
    return byte;
  }
  uint64_t Varint() {
    uint64_t value = 0;
    for (int shift = 0; shift < 64 && !rest_.empty(); shift += 7) {
      const uint8_t byte = Byte();
      value |= uint64_t{byte & 127U} << shift;
      if (byte < 128) return value;
    }
    ok_ = false;
    return 0;
  }
  std::string Text() {
    const uint64_t size = Varint();
    if (size > rest_.size()) ok_ = false;
    if (!ok_) return "";
    std::string text(rest_.substr(0, size));
    rest_.remove_prefix(size);
    return text;
  }

 private:
  absl::string_view rest_;
  bool ok_ = true;
};

absl::Status Damaged() {
  return absl::DataLossError("ledger: expected rows, received other bytes");
}

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

std::string PackRows(const UsageRows& rows) {
  std::map<absl::string_view, uint64_t> sizes;  // rows of each series
  for (const auto& [key, counts] : rows) ++sizes[key.first];
  std::string plain;
  PutVarint(kUsageFields, &plain);
  PutVarint(sizes.size(), &plain);
  for (const auto& [series, size] : sizes) {
    PutVarint(series.size(), &plain);
    absl::StrAppend(&plain, series);
    PutVarint(size, &plain);
  }
  // Neighbours in a column are alike, and bytes of equal weight even more: this is what compresses.
  const auto put_column = [&](auto value_of) {
    std::vector<uint64_t> column;
    uint64_t bits = 0;
    int64_t last = 0;
    const std::string* series = nullptr;
    for (const auto& row : rows) {
      if (series == nullptr || row.first.first != *series) last = 0;
      series = &row.first.first;
      const int64_t value = value_of(row);
      column.push_back(Zigzag(value - std::exchange(last, value)));
      bits |= column.back();
    }
    PutVarint(bits, &plain);
    for (; bits > 0; bits >>= 8) {
      for (uint64_t& value : column) {
        plain.push_back(static_cast<char>(value));
        value >>= 8;
      }
    }
  };
  put_column([](const auto& row) { return row.first.second; });
  for (size_t field = 0; field < kUsageFields; ++field) {
    put_column([field, scale = ScaleOf(field)](const auto& row) {
      return std::llround(row.second.values[field] * scale);
    });
  }
  uLongf size = compressBound(plain.size());
  std::string packed(size, '\0');
  compress2(reinterpret_cast<Bytef*>(packed.data()), &size,
            reinterpret_cast<const Bytef*>(plain.data()), plain.size(), Z_BEST_COMPRESSION);
  packed.resize(size);
  std::string head(1, kVersion);
  PutVarint(plain.size(), &head);
  PutVarint(packed.size(), &head);
  return head + packed;
}

absl::StatusOr<std::vector<UsageRow>> UnpackRows(absl::string_view bytes) {
  if (bytes.empty() || bytes[0] != kVersion) return Damaged();
  Reader head(bytes.substr(1));
  uLongf size = head.Varint();
  const std::string packed = head.Text();
  if (!head.ok() || !head.at_end() || size > kMostUnpacked) return Damaged();
  std::string plain(size, '\0');
  if (uncompress(reinterpret_cast<Bytef*>(plain.data()), &size,
                 reinterpret_cast<const Bytef*>(packed.data()), packed.size()) != Z_OK ||
      size != plain.size()) {
    return Damaged();
  }
  Reader reader(plain);
  const uint64_t fields = reader.Varint();
  std::vector<UsageRow> rows;
  std::vector<bool> is_first;  // of its series
  for (uint64_t series = reader.Varint(); series > 0 && reader.ok(); --series) {
    const std::string key = reader.Text();
    const uint64_t count = reader.Varint();
    if (count > plain.size()) return Damaged();
    for (uint64_t i = 0; i < count; ++i) {
      rows.push_back({.series = key});
      is_first.push_back(i == 0);
    }
    if (rows.size() > plain.size()) return Damaged();
  }
  for (uint64_t column = 0; column < fields + 1 && reader.ok(); ++column) {
    std::vector<uint64_t> values(rows.size());
    int shift = 0;
    for (uint64_t bits = reader.Varint(); bits > 0; bits >>= 8, shift += 8) {
      for (uint64_t& value : values) value |= uint64_t{reader.Byte()} << shift;
    }
    uint64_t last = 0;
    for (size_t i = 0; i < rows.size(); ++i) {
      last = (is_first[i] ? 0 : last) + static_cast<uint64_t>(Unzigzag(values[i]));
      const auto value = static_cast<int64_t>(last);
      if (column == 0) {
        rows[i].hour = value;
      } else if (column <= kUsageFields) {
        rows[i].counts.values[column - 1] = static_cast<double>(value) / ScaleOf(column - 1);
      }
    }
  }
  if (!reader.ok() || !reader.at_end()) return Damaged();
  return rows;
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
