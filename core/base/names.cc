#include "core/base/names.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <tuple>
#include <utility>

#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"

namespace spikeserve {
namespace {

constexpr size_t kMostNames = 40;
constexpr size_t kMostBytes = 600;   // of all names that are shown
constexpr size_t kLongestName = 60;  // of which an error shows all
constexpr size_t kLongestTypo = 64;  // longer names are not compared letter by letter
constexpr size_t kMostDifferences = 2;

size_t CommonPrefix(absl::string_view a, absl::string_view b) {
  const auto end = std::mismatch(a.begin(), a.end(), b.begin(), b.end());
  return static_cast<size_t>(end.first - a.begin());
}

// Returns the number of letters that are missing, added, replaced or exchanged with their
// neighbour, or more than kMostDifferences if it is larger. Takes time in proportion to the length.
size_t Differences(absl::string_view a, absl::string_view b) {
  constexpr size_t kFar = kMostDifferences + 1;
  if (std::max(a.size(), b.size()) > kLongestTypo) return kFar;
  if (std::max(a.size(), b.size()) - std::min(a.size(), b.size()) > kMostDifferences) return kFar;
  using Row = std::array<size_t, kLongestTypo + 1>;
  std::array<Row, 3> rows;
  for (Row& row : rows) row.fill(kFar);
  for (size_t j = 0; j <= b.size(); ++j) rows[0][j] = std::min(j, kFar);
  for (size_t i = 1; i <= a.size(); ++i) {
    const Row &before = rows[(i + 1) % 3], &last = rows[(i - 1) % 3];
    Row& row = rows[i % 3];
    row.fill(kFar);
    if (i <= kMostDifferences) row[0] = i;
    const size_t first = i > kMostDifferences ? i - kMostDifferences : 1;
    for (size_t j = first; j <= std::min(b.size(), i + kMostDifferences); ++j) {
      row[j] = std::min({last[j] + 1, row[j - 1] + 1, last[j - 1] + (a[i - 1] != b[j - 1]), kFar});
      const bool exchanged = i > 1 && j > 1 && a[i - 1] == b[j - 2] && a[i - 2] == b[j - 1];
      if (exchanged) row[j] = std::min(row[j], before[j - 2] + 1);
    }
  }
  return rows[a.size() % 3][b.size()];
}

// Moves the names that are most like `received` to the front.
void SortByLikeness(absl::string_view received, std::vector<std::string>* names) {
  // By different letters, then by what is left beside a common beginning.
  std::vector<std::tuple<size_t, size_t, std::string>> keys;
  for (std::string& name : *names) {
    const size_t differences = Differences(received, name);
    const size_t left = name.size() + received.size() - 2 * CommonPrefix(received, name);
    keys.emplace_back(differences, left, std::move(name));
  }
  const auto shown = static_cast<std::ptrdiff_t>(std::min(keys.size(), kMostNames));
  std::partial_sort(keys.begin(), keys.begin() + shown, keys.end());
  for (size_t i = 0; i < keys.size(); ++i) (*names)[i] = std::move(std::get<2>(keys[i]));
}

}  // namespace

std::string NamesLike(absl::string_view received, std::vector<std::string> known) {
  size_t bytes = 0;
  for (const std::string& name : known) bytes += name.size();
  if (known.size() > kMostNames || bytes > kMostBytes) SortByLikeness(received, &known);
  std::string text;
  size_t shown = 0;
  for (const std::string& name : known) {
    const absl::string_view start = absl::string_view(name).substr(0, kLongestName);
    if (shown == kMostNames || text.size() + start.size() > kMostBytes) break;
    absl::StrAppend(&text, shown == 0 ? "" : ", ", start, start == name ? "" : "...");
    ++shown;
  }
  return shown == known.size() ? text : absl::StrCat(text, " and ", known.size() - shown, " more");
}

std::string DidYouMean(absl::string_view received, const std::vector<std::string>& known) {
  const size_t allowed = received.size() < 4 ? 1 : kMostDifferences;
  const std::string* nearest = nullptr;
  size_t least = allowed + 1;
  for (const std::string& name : known) {
    const size_t differences =
        absl::EqualsIgnoreCase(received, name) ? 0 : Differences(received, name);
    if (differences >= least) continue;
    least = differences;
    nearest = &name;
  }
  return nearest == nullptr ? "" : absl::StrCat("; did you mean ", *nearest, "?");
}

}  // namespace spikeserve
