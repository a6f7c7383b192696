#include "server/usage/ledger.h"

#include <algorithm>
#include <iterator>

#include "absl/strings/str_cat.h"
#include "core/base/status_macros.h"
#include "core/engine/energy.h"
#include "core/journal/session_journal.h"
#include "prometheus/client_metric.h"
#include "server/base/log.h"

namespace spikeserve {
namespace {

constexpr size_t kBatchSessions = 256;  // of a batch, which a script of Redis books

// How often the store hears of a session without decisions, and how much longer it remembers one
// than its journal can live.
constexpr absl::Duration kRefresh = absl::Hours(1);
constexpr absl::Duration kRemembered = absl::Hours(3);

constexpr absl::Duration kMaintenance = absl::Minutes(10);

// The series of tenants for Prometheus; the other tenants are one series.
constexpr size_t kMostTenantSeries = 100;
constexpr char kOthers[] = "other";

UsageTotals TotalsOf(const Session& session) {
  return {static_cast<double>(session.decisions), static_cast<double>(session.spikes),
          session.energy_joules};
}

// Returns what this process has counted of the session since it has it.
UsageCounts CountsOf(SessionEntry& entry, absl::Duration now)
    ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex) {
  UsageCounts counts;
  const SessionLife& life = entry.agent.life();
  if (entry.journal == nullptr) {
    const UsageTotals totals = TotalsOf(entry.agent.session());
    std::copy(totals.begin(), totals.end(), counts.values.begin());
  }
  const ModelConfig& config = entry.agent.policy().config;
  const auto joules = [&](EnergyModel model) {
    return EstimateEnergy(model, life.counts(), config).value_or(0.0);
  };
  counts[UsageField::kInt45nm] = joules(EnergyModel::kInt45nm);
  counts[UsageField::kIntSram45nm] = joules(EnergyModel::kIntSram45nm);
  const BeatCounts& beats = entry.robot.beats();
  counts[UsageField::kFresh] = static_cast<double>(beats.fresh);
  counts[UsageField::kHeld] = static_cast<double>(beats.held);
  counts[UsageField::kLocal] = static_cast<double>(beats.local);
  counts[UsageField::kSafe] = static_cast<double>(beats.safe);
  counts[UsageField::kSessionSeconds] = absl::ToDoubleSeconds(now - entry.agent.created());
  counts[UsageField::kContributions] = static_cast<double>(entry.agent.contributions());
  counts[UsageField::kSessions] = entry.journal == nullptr || entry.journal->is_new() ? 1.0 : 0.0;
  return counts;
}

// Returns the totals that the session store has, as far as the last look at the session tells.
UsageTotals StoredTotals(SessionEntry& entry) ABSL_EXCLUSIVE_LOCKS_REQUIRED(entry.mutex) {
  SessionUsage& usage = entry.usage;
  const Session& session = entry.agent.session();
  const auto changes = static_cast<double>(session.changes());
  const auto stored = static_cast<double>(entry.journal->durable_changes());
  UsageTotals totals = usage.totals;
  if (usage.seen_changes >= 0.0 && usage.seen_changes <= stored) totals = usage.seen;
  usage.seen = TotalsOf(session);
  usage.seen_changes = changes;
  return changes <= stored ? usage.seen : totals;
}

prometheus::MetricFamily GaugeFamily(const char* name, const char* help) {
  return {.name = name, .help = help, .type = prometheus::MetricType::Gauge, .metric = {}};
}

void AddGauge(std::vector<prometheus::ClientMetric::Label> labels, double value,
              prometheus::MetricFamily* family) {
  prometheus::ClientMetric metric;
  metric.label = std::move(labels);
  metric.gauge.value = value;
  family->metric.push_back(std::move(metric));
}

absl::Time NextMonth(absl::Time time) {
  return absl::FromCivil(absl::ToCivilMonth(time, absl::UTCTimeZone()) + 1, absl::UTCTimeZone());
}

}  // namespace

Ledger::Ledger(LedgerOptions options, std::shared_ptr<UsageStore> books,
               std::shared_ptr<UsageStore> reads, FindOwnerless find_ownerless,
               SessionStore* sessions, const Authenticator* authenticator, const Clock* clock)
    : options_(std::move(options)),
      books_(std::move(books)),
      reads_(std::move(reads)),
      finds_ownerless_(std::move(find_ownerless)),
      sessions_(*sessions),
      authenticator_(*authenticator),
      clock_(*clock) {}

void Ledger::Take(SessionEntry& entry, bool is_closed, Pending* pending) const {
  SessionUsage& usage = entry.usage;
  const bool was_closed = std::exchange(usage.is_closed, usage.is_closed || is_closed);
  const absl::Duration now = was_closed ? absl::Seconds(usage.booked_at) : clock_.Now();
  const SessionJournal* const journal = entry.journal.get();
  // Of ASYNC, all is answered at once. It counts even if another server has taken the session over
  // before the store had it: whoever decides it again, the ledger takes the most of both.
  const bool is_answered = journal != nullptr && !journal->is_sync();
  const bool is_stored = journal != nullptr && !was_closed && (is_answered || !journal->lost());
  UsageTotals totals = usage.totals;
  if (is_stored) {
    const UsageTotals stored = StoredTotals(entry);
    totals = is_closed || is_answered ? usage.seen : stored;
  }
  UsageCounts added = CountsOf(entry, now);
  const UsageCounts counted = added;
  for (size_t i = 0; i < kUsageFields; ++i) added.values[i] -= usage.booked.values[i];
  const double seconds = absl::ToDoubleSeconds(now);
  const bool is_due = seconds - usage.booked_at >= absl::ToDoubleSeconds(kRefresh);
  UsageCounts other = added;  // than time, which alone is booked now and then
  other[UsageField::kSessionSeconds] = 0.0;
  const bool is_end = is_closed && !was_closed;
  if (!is_end && !is_due && totals == usage.totals && other == UsageCounts()) return;
  const std::string series = SeriesOf(entry.agent.session().options, options_.label).ToKey();
  pending->added[series] += added;
  if (is_stored) pending->totals.push_back({journal->stored_as(), series, totals});
  usage.booked = counted;
  usage.totals = totals;
  usage.booked_at = seconds;
}

void Ledger::OnClosed(SessionEntry& entry) {
  Pending taken;
  {
    absl::MutexLock lock(&entry.mutex);
    Take(entry, /*is_closed=*/true, &taken);
  }
  absl::MutexLock lock(&mutex_);
  closed_.Add(std::move(taken));
}

void Ledger::BookEnds() { Book({}); }

void Ledger::TakeTenants(Pending* pending) {
  for (const auto& tenant : authenticator_.Tenants()) {
    const std::pair now = {tenant->refusals().refusals(), tenant->received_bytes()};
    const auto before = std::exchange(calls_[tenant->name()], now);
    // A tenant that was removed from the tokens file and came back counts anew.
    if (now == before || now.first < before.first || now.second < before.second) continue;
    UsageCounts& counts = pending->added[UsageSeries{.tenant = tenant->name()}.ToKey()];
    counts[UsageField::kRefusedCalls] += static_cast<double>(now.first - before.first);
    counts[UsageField::kBytes] += static_cast<double>(now.second - before.second);
  }
}

void Ledger::Pending::Add(Pending more) {
  for (const auto& [series, counts] : more.added) added[series] += counts;
  std::ranges::move(more.totals, std::back_inserter(totals));
}

Ledger::Pending Ledger::TakeClosed() {
  absl::MutexLock lock(&mutex_);
  return std::exchange(closed_, {});
}

bool Ledger::Book(Pending pending) {
  absl::MutexLock lock(&book_mutex_);
  // Within the lock, so that a call that finds nothing here returns when it is booked.
  pending.Add(TakeClosed());
  const absl::Time now = options_.now();
  // While the store is away, an hour has one batch of what changes all the time. The first batch
  // may have arrived there.
  if (pending.totals.empty() && unbooked_.size() > 1 &&
      OpenPart(unbooked_.back().time) == OpenPart(now)) {
    UsageBatch& last = unbooked_.back();
    for (const auto& [series, counts] : std::exchange(pending.added, {})) {
      last.added[series] += counts;
    }
  }
  size_t first = 0;
  while (!pending.added.empty() || first < pending.totals.size()) {
    const size_t end = std::min(first + kBatchSessions, pending.totals.size());
    UsageBatch batch = {.source = options_.process, .number = ++batches_, .time = now};
    std::swap(batch.added, pending.added);
    for (; first < end; ++first) batch.totals.push_back(std::move(pending.totals[first]));
    unbooked_.push_back(std::move(batch));
  }
  while (!unbooked_.empty()) {
    const auto status = books_->Book(unbooked_.front());
    Note("ledger not written; tries again", status);
    if (!status.ok()) return false;
    unbooked_.pop_front();
  }
  return true;
}

void Ledger::Note(const char* what, const absl::Status& status) const {
  if (!status.ok()) LogWarning(what, {{"error", status.message()}});
}

bool Ledger::BookAll() {
  Pending pending;
  sessions_.ForEach([](const SessionEntry&) { return true; },
                    [&](const ListedSession& session) {
                      absl::MutexLock lock(&session.entry->mutex);
                      Take(*session.entry, /*is_closed=*/false, &pending);
                    });
  TakeTenants(&pending);
  return Book(std::move(pending));
}

void Ledger::Tick() {
  if (!BookAll()) return;
  BookOwnerless();
  FollowMonth();
  Maintain();
}

void Ledger::BookOwnerless() {
  if (finds_ownerless_ == nullptr || !find_ownerless_.exchange(false)) return;
  auto found = finds_ownerless_();
  Note("journals of lost servers not read for the ledger; tries again", found.status());
  if (!found.ok()) return find_ownerless_.store(true);
  Book({.added = {}, .totals = *std::move(found)});
}

void Ledger::FollowMonth() {
  const absl::Time now = options_.now();
  auto month = reads_->MonthOf(now);
  Note("budgets not compared with the ledger; tries again", month.status());
  if (!month.ok()) return;
  for (const auto& tenant : authenticator_.Tenants()) {
    tenant->SetSpent((*month)[tenant->name()], NextMonth(now));
  }
  absl::MutexLock lock(&mutex_);
  month_ = *std::move(month);
}

void Ledger::Maintain() {
  const absl::Duration now = clock_.Now();
  if (now - maintained_ < kMaintenance) return;
  maintained_ = now;
  Note("ledger not compacted; tries again", CompactUsage(*reads_, options_.now()));
  const absl::Duration life = std::max(options_.session_life, kRefresh) + kRemembered;
  Note("ledger not compacted; tries again", reads_->Forget(life));
}

std::vector<TenantBudgets> Ledger::Budgets() const {
  std::vector<TenantBudgets> all;
  for (const auto& tenant : authenticator_.Tenants()) {
    auto budgets = tenant->Budgets();
    if (!budgets.empty()) all.push_back({tenant->name(), std::move(budgets)});
  }
  return all;
}

std::vector<prometheus::MetricFamily> Ledger::Collect() const {
  auto ratio = GaugeFamily("spikeserve_budget_ratio",
                           "Part of a tenant's budget of this month that is spent.");
  for (const TenantBudgets& tenant : Budgets()) {
    for (const BudgetState& budget : tenant.budgets) {
      AddGauge({{"tenant", tenant.tenant}, {"budget", budget.name}}, budget.spent / budget.limit,
               &ratio);
    }
  }
  if (!options_.tenant_metrics) return {std::move(ratio)};
  std::vector<std::pair<std::string, UsageCounts>> tenants;
  {
    absl::MutexLock lock(&mutex_);
    tenants.assign(month_.begin(), month_.end());
  }
  std::ranges::stable_sort(tenants, std::greater<>(), [](const auto& tenant) {
    return tenant.second[UsageField::kHorowitz45nm];
  });
  while (tenants.size() > kMostTenantSeries) {
    const UsageCounts counts = tenants.back().second;
    tenants.pop_back();
    tenants.back().second += counts;
    tenants.back().first = kOthers;
  }
  auto decisions = GaugeFamily("spikeserve_tenant_month_decisions",
                               "Decisions of a tenant in this month of UTC, on all servers with "
                               "the same store.");
  auto joules = GaugeFamily("spikeserve_tenant_month_joules",
                            "Estimated energy of a tenant in this month, by model, as above.");
  for (const auto& [tenant, counts] : tenants) {
    AddGauge({{"tenant", tenant}}, counts[UsageField::kDecisions], &decisions);
    for (const UsageField model : kJoulesFields) {
      AddGauge({{"tenant", tenant}, {"model", std::string(ToString(model))}}, counts[model],
               &joules);
    }
  }
  return {std::move(ratio), std::move(decisions), std::move(joules)};
}

}  // namespace spikeserve
