// Packed rows: columns of integers whose neighbours predict each other, compressed by zlib.
#include <zlib.h>

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdlib>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/types/span.h"
#include "core/base/status_macros.h"
#include "server/usage/usage_rows.h"

namespace spikeserve {
namespace {

constexpr char kVersion = 1;

constexpr int kCoarseBits = 12;

// The most bytes that a part of rows has when it is not compressed.
constexpr uint64_t kMostUnpacked = uint64_t{1} << 30;

// How a field is packed, in a column of its own.
struct Column {
  double scale;    // numbers are stored as integers: this many for 1
  size_t base;     // a field before it, to which it is nearly proportional; itself: none
  bool is_coarse;  // see Coarsen()
};

Column ColumnOf(size_t field) {
  constexpr auto kBase = [](UsageField base) { return static_cast<size_t>(base); };
  switch (static_cast<UsageField>(field)) {
    case UsageField::kSpikes:
      return {1.0, kBase(UsageField::kDecisions), true};
    case UsageField::kHorowitz45nm:
      return {1e10, kBase(UsageField::kSpikes), true};
    case UsageField::kInt45nm:
    case UsageField::kIntSram45nm:
      return {1e10, kBase(UsageField::kHorowitz45nm), true};
    case UsageField::kSessionSeconds:
      return {1e3, kBase(UsageField::kDecisions), true};
    case UsageField::kDecisions:
      return {1.0, field, false};
    default:
      return {1.0, kBase(UsageField::kDecisions), field == kBase(UsageField::kBytes)};
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

// Rounds the numbers of a series to multiples of a power of two, of which the largest one has at
// most 2^kCoarseBits, so that their sum up to each row is rounded alike. Divides them by it, writes
// its exponent to `exponent`, and returns what the sum of all has lost.
int64_t Coarsen(absl::Span<int64_t> numbers, int64_t* exponent) {
  int64_t largest = 0;
  for (const int64_t number : numbers) largest = std::max(largest, std::abs(number));
  const int width = std::bit_width(static_cast<uint64_t>(largest));
  *exponent = std::max(0, width - kCoarseBits);
  const int64_t half = (int64_t{1} << *exponent) >> 1;
  int64_t exact = 0, rounded = 0;
  for (int64_t& number : numbers) {
    exact += number;
    const int64_t before = std::exchange(rounded, (exact + half) >> *exponent);
    number = rounded - before;
  }
  return exact - (rounded << *exponent);
}

// The reverse of Coarsen(): the last number takes what the sum had lost.
void Refine(absl::Span<int64_t> numbers, int64_t exponent, int64_t lost) {
  for (int64_t& number : numbers) {
    number = static_cast<int64_t>(static_cast<uint64_t>(number) << exponent);
  }
  numbers.back() =
      static_cast<int64_t>(static_cast<uint64_t>(numbers.back()) + static_cast<uint64_t>(lost));
}

// Returns what a number probably is, from the one in the row before, and those of the base there
// and here. Exact arithmetic of IEEE 754, so that every reader predicts the same.
int64_t Predict(int64_t before, int64_t base_before, int64_t base) {
  if (base_before <= 0) return before;
  const double predicted =
      static_cast<double>(before) * (static_cast<double>(base) / static_cast<double>(base_before));
  return std::abs(predicted) < 1e18 ? std::llround(predicted) : before;
}

using Numbers = std::vector<int64_t>;
using Ends = std::vector<size_t>;  // of the rows of each series

// Calls `use` with each row that has one of its series before it, which is `row` - 1.
template <typename Use>
void ForEachNext(const Ends& ends, Use use) {
  size_t row = 0;
  for (const size_t end : ends) {
    for (++row; row < end; ++row) use(row);
  }
}

// Bytes of equal weight are neighbours: this is what compresses.
void PutNumbers(const Numbers& numbers, std::string* out) {
  std::vector<uint64_t> rest;
  uint64_t bits = 0;
  for (const int64_t number : numbers) bits |= rest.emplace_back(Zigzag(number));
  PutVarint(bits, out);
  for (; bits > 0; bits >>= 8) {
    for (uint64_t& number : rest) {
      out->push_back(static_cast<char>(number));
      number >>= 8;
    }
  }
}

Numbers TakeNumbers(size_t count, Reader* reader) {
  std::vector<uint64_t> values(count);
  int shift = 0;
  for (uint64_t bits = reader->Varint(); bits > 0; bits >>= 8, shift += 8) {
    for (uint64_t& value : values) value |= uint64_t{reader->Byte()} << shift;
  }
  Numbers numbers;
  for (const uint64_t value : values) numbers.push_back(Unzigzag(value));
  return numbers;
}

// Calls `use` with the numbers of each series, and its index.
template <typename Use>
void ForEachSeries(const Ends& ends, Numbers* numbers, Use use) {
  size_t begin = 0;
  for (size_t i = 0; i < ends.size(); ++i) {
    use(absl::MakeSpan(*numbers).subspan(begin, ends[i] - begin), i);
    begin = ends[i];
  }
}

// Appends the numbers of a field, which afterwards are what TakeColumn() returns.
void PutColumn(const Column& column, const Ends& ends, const Numbers& base, Numbers* numbers,
               std::string* out) {
  Numbers exponents(ends.size()), lost(ends.size());
  if (column.is_coarse) {
    ForEachSeries(ends, numbers, [&](absl::Span<int64_t> series, size_t i) {
      lost[i] = Coarsen(series, &exponents[i]);
    });
    PutNumbers(exponents, out);
    PutNumbers(lost, out);
  }
  Numbers errors = *numbers;
  ForEachNext(ends, [&](size_t row) {
    errors[row] -= Predict((*numbers)[row - 1], base.empty() ? 0 : base[row - 1],
                           base.empty() ? 0 : base[row]);
  });
  PutNumbers(errors, out);
  ForEachSeries(ends, numbers, [&](absl::Span<int64_t> series, size_t i) {
    Refine(series, exponents[i], lost[i]);
  });
}

Numbers TakeColumn(const Column& column, const Ends& ends, const Numbers& base, Reader* reader) {
  Numbers exponents(ends.size()), lost(ends.size());
  if (column.is_coarse) {
    exponents = TakeNumbers(ends.size(), reader);
    lost = TakeNumbers(ends.size(), reader);
  }
  Numbers numbers = TakeNumbers(ends.empty() ? 0 : ends.back(), reader);
  ForEachNext(ends, [&](size_t row) {
    const int64_t predicted =
        Predict(numbers[row - 1], base.empty() ? 0 : base[row - 1], base.empty() ? 0 : base[row]);
    numbers[row] = static_cast<int64_t>(static_cast<uint64_t>(numbers[row]) +
                                        static_cast<uint64_t>(predicted));
  });
  ForEachSeries(ends, &numbers, [&](absl::Span<int64_t> series, size_t i) {
    Refine(series, exponents[i] & 63, lost[i]);
  });
  return numbers;
}

std::string Compress(const std::string& plain) {
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

absl::StatusOr<std::string> Uncompress(absl::string_view bytes) {
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
  return plain;
}

}  // namespace

std::string PackRows(const UsageRows& rows) {
  std::map<absl::string_view, uint64_t> sizes;  // rows of each series
  for (const auto& [key, counts] : rows) ++sizes[key.first];
  std::string plain;
  PutVarint(kUsageFields, &plain);
  PutVarint(sizes.size(), &plain);
  Ends ends;
  for (const auto& [series, size] : sizes) {
    PutVarint(series.size(), &plain);
    absl::StrAppend(&plain, series);
    PutVarint(size, &plain);
    ends.push_back((ends.empty() ? 0 : ends.back()) + size);
  }
  Numbers hours;
  for (const auto& [key, counts] : rows) hours.push_back(key.second);
  PutColumn({.scale = 1.0, .base = 0, .is_coarse = false}, ends, {}, &hours, &plain);
  std::array<Numbers, kUsageFields> numbers;
  for (size_t field = 0; field < kUsageFields; ++field) {
    const Column column = ColumnOf(field);
    for (const auto& [key, counts] : rows) {
      numbers[field].push_back(std::llround(counts.values[field] * column.scale));
    }
    const Numbers& base = numbers[column.base];
    PutColumn(column, ends, column.base == field ? Numbers() : base, &numbers[field], &plain);
  }
  return Compress(plain);
}

absl::StatusOr<std::vector<UsageRow>> UnpackRows(absl::string_view bytes) {
  ASSIGN_OR_RETURN(const std::string plain, Uncompress(bytes));
  Reader reader(plain);
  const uint64_t fields = reader.Varint();
  std::vector<UsageRow> rows;
  Ends ends;
  for (uint64_t series = reader.Varint(); series > 0 && reader.ok(); --series) {
    const std::string key = reader.Text();
    const uint64_t count = reader.Varint();
    if (count == 0 || count > plain.size() || rows.size() + count > plain.size()) return Damaged();
    rows.resize(rows.size() + count, {.series = key});
    ends.push_back(rows.size());
  }
  const Numbers hours =
      TakeColumn({.scale = 1.0, .base = 0, .is_coarse = false}, ends, {}, &reader);
  for (size_t i = 0; i < rows.size(); ++i) rows[i].hour = hours[i];
  std::array<Numbers, kUsageFields> numbers;
  for (size_t field = 0; field < std::min<uint64_t>(fields, kUsageFields) && reader.ok(); ++field) {
    const Column column = ColumnOf(field);
    const Numbers& base = numbers[column.base];
    numbers[field] = TakeColumn(column, ends, column.base == field ? Numbers() : base, &reader);
    for (size_t i = 0; i < rows.size(); ++i) {
      rows[i].counts.values[field] = static_cast<double>(numbers[field][i]) / column.scale;
    }
  }
  if (!reader.ok() || (fields <= kUsageFields && !reader.at_end())) return Damaged();
  return rows;
}

}  // namespace spikeserve
