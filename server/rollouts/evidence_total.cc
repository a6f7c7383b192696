#include "server/rollouts/evidence_total.h"

#include <algorithm>
#include <numeric>
#include <utility>

namespace spikeserve {
namespace {

constexpr size_t kTrimmed = 10;  // one in this many values, at each end

void AppendReturns(const VersionEvidence::TenantCounts& counts, double less,
                   std::vector<double>* values) {
  for (const auto& session : counts.returns) values->push_back(session.mean - less);
}

// Returns how much a variance grows if the means of `tenants` groups of values are taken from the
// values.
double VarianceFactor(size_t values, size_t tenants) {
  // The mean of all tenants is not taken from them: a comparison cancels it.
  const auto lost = static_cast<double>(tenants) - 1.0;
  const auto all = static_cast<double>(values);
  return all > lost + 2.0 ? all / (all - lost) : 1.0;
}

}  // namespace

TrimmedMean TrimmedMeanOf(std::vector<double>& values) {
  const size_t count = values.size();
  if (count == 0) return {};
  const size_t trimmed = std::min((count + kTrimmed - 1) / kTrimmed, (count - 1) / 2);
  const auto first = values.begin() + static_cast<std::ptrdiff_t>(trimmed);
  const auto last = values.end() - static_cast<std::ptrdiff_t>(trimmed) - 1;
  std::nth_element(values.begin(), first, values.end());
  const double low = *first;  // the next line may move it
  std::nth_element(first, last, values.end());
  const double high = *last;
  const auto kept = static_cast<double>(count - 2 * trimmed);
  TrimmedMean result = {.count = static_cast<int64_t>(count)};
  result.mean = std::accumulate(first, last + 1, 0.0) / kept;
  if (kept < 2.0) return result;
  // The values that are left out count as the nearest ones that are kept.
  const auto ends = static_cast<double>(trimmed);
  const double middle = (result.mean * kept + ends * (low + high)) / static_cast<double>(count);
  const auto square = [&](double value) { return (value - middle) * (value - middle); };
  double squares = ends * (square(low) + square(high));
  for (auto value = first; value <= last; ++value) squares += square(*value);
  result.variance = static_cast<double>(count) * squares / (kept * (kept - 1.0));
  return result;
}

EvidenceTotal TotalOf(const VersionEvidence::Counts& counts, const std::string* without) {
  EvidenceTotal total;
  std::vector<double> returns;
  for (const auto& [tenant, of] : counts) {
    if (without != nullptr && tenant == *without) continue;
    total.sessions += of.sessions;
    total.failed_sessions += of.failed_sessions;
    total.episodes += of.episodes;
    total.implausible += of.implausible;
    total.capped_episodes += of.capped_episodes;
    total.durations.Add(of.durations);
    AppendReturns(of, /*less=*/0.0, &returns);
  }
  total.returns = TrimmedMeanOf(returns);
  return total;
}

CenteredReturns CenterReturns(const VersionEvidence::Counts& new_version,
                              const VersionEvidence::Counts& stable_version,
                              const std::string* without) {
  std::vector<double> fresh;
  std::vector<double> old;
  std::vector<double> both;
  size_t tenants = 0;
  for (const auto& [tenant, of] : new_version) {
    const auto other = stable_version.find(tenant);
    if (other == stable_version.end() || (without != nullptr && tenant == *without)) continue;
    if (of.returns.empty() || other->second.returns.empty()) continue;
    ++tenants;
    both.clear();
    AppendReturns(of, /*less=*/0.0, &both);
    AppendReturns(other->second, /*less=*/0.0, &both);
    const double middle = TrimmedMeanOf(both).mean;
    AppendReturns(of, middle, &fresh);
    AppendReturns(other->second, middle, &old);
  }
  CenteredReturns centered = {.new_version = TrimmedMeanOf(fresh),
                              .stable_version = TrimmedMeanOf(old)};
  if (tenants == 0) return centered;
  const double factor = VarianceFactor(fresh.size() + old.size(), tenants);
  centered.new_version.variance *= factor;
  centered.stable_version.variance *= factor;
  centered.new_values = std::move(fresh);
  centered.stable_values = std::move(old);
  return centered;
}

}  // namespace spikeserve
