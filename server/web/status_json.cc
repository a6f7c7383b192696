#include "server/web/status_json.h"

#include <algorithm>
#include <cstdint>
#include <map>
#include <tuple>
#include <utility>

#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/json.h"
#include "core/base/version.h"
#include "nlohmann/json.hpp"
#include "prometheus/metric_type.h"
#include "proto/json.h"
#include "server/admin/session_info.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;

constexpr int64_t kDefaultLimit = 50;
constexpr int64_t kLargestLimit = 1000;

Json SeriesToJson(const prometheus::ClientMetric& metric, prometheus::MetricType type) {
  Json series = {{"labels", Json::object()}};
  for (const auto& label : metric.label) series["labels"][label.name] = label.value;
  switch (type) {
    case prometheus::MetricType::Counter:
      series["value"] = metric.counter.value;
      break;
    case prometheus::MetricType::Gauge:
      series["value"] = metric.gauge.value;
      break;
    case prometheus::MetricType::Histogram:
      series["count"] = metric.histogram.sample_count;
      series["sum"] = metric.histogram.sample_sum;
      series["buckets"] = Json::array();
      for (const auto& bucket : metric.histogram.bucket) {
        // The library writes an infinite bound as null.
        series["buckets"].push_back({bucket.upper_bound, bucket.cumulative_count});
      }
      break;
    default:  // the server exports no other types
      break;
  }
  return series;
}

// What a session is sorted by. Small, because there is one for every session up to the end of the
// page.
struct SortKey {
  std::string text = {};
  double number = 0.0;
};

using KeyOf = SortKey (*)(const ListedSession&, const AgentSession&);

template <auto Field>
SortKey Number(const ListedSession& /*listed*/, const AgentSession& agent) {
  return {.number = static_cast<double>(agent.session().*Field)};
}

double SpikesPerDecision(const Session& session) {
  const double decisions = static_cast<double>(std::max<uint64_t>(session.decisions, 1));
  return static_cast<double>(session.spikes) / decisions;
}

const std::map<std::string, KeyOf>& Columns() {
  using Listed = const ListedSession&;
  using Agent = const AgentSession&;
  static const auto* const columns = new std::map<std::string, KeyOf>{
      {"session_id", [](Listed listed, Agent) { return SortKey{.text = listed.id}; }},
      {"policy",
       [](Listed, Agent agent) {
         const SessionOptions& options = agent.session().options;
         return SortKey{.text = options.policy, .number = static_cast<double>(options.version)};
       }},
      {"episode", Number<&Session::episode>},
      {"step", Number<&Session::step>},
      {"episode_return", Number<&Session::episode_return>},
      {"decisions", Number<&Session::decisions>},
      {"spikes_per_decision",
       [](Listed, Agent agent) { return SortKey{.number = SpikesPerDecision(agent.session())}; }},
      {"energy_joules", Number<&Session::energy_joules>},
      {"head_drift", [](Listed, Agent agent) { return SortKey{.number = agent.HeadDrift()}; }},
      {"idle_seconds",
       [](Listed listed, Agent) { return SortKey{.number = absl::ToDoubleSeconds(listed.idle)}; }},
  };
  return *columns;
}

// The order of a list of sessions.
struct Order {
  KeyOf key;
  bool descending;
};

absl::StatusOr<Order> OrderOf(const HttpQuery& query) {
  const std::string sort = query.Get("sort", "session_id");
  const auto column = Columns().find(sort);
  if (column == Columns().end()) {
    return absl::InvalidArgumentError(absl::StrCat(
        "sort: expected one of ",
        absl::StrJoin(Columns(), ", ",
                      [](std::string* out, const auto& known) { out->append(known.first); }),
        ", received ", Quoted(sort)));
  }
  const std::string order = query.Get("order", "ascending");
  if (order == "ascending" || order == "descending") {
    return Order{.key = column->second, .descending = order == "descending"};
  }
  return absl::InvalidArgumentError(
      absl::StrCat("order: expected ascending or descending, received ", Quoted(order)));
}

// A session in a list.
struct Row {
  SortKey key;
  ListedSession session;
};

// Keeps the first `limit` rows in an order. Sessions with equal keys are sorted by id.
class FirstRows {
 public:
  FirstRows(bool descending, size_t limit) : descending_(descending), limit_(limit) {}

  void Add(Row row) {
    const auto before = [this](const Row& a, const Row& b) { return IsBefore(a, b); };
    if (rows_.size() == limit_) {
      if (!IsBefore(row, rows_.front())) return;
      std::pop_heap(rows_.begin(), rows_.end(), before);
      rows_.pop_back();
    }
    rows_.push_back(std::move(row));
    std::push_heap(rows_.begin(), rows_.end(), before);
  }

  // Returns the rows in their order.
  std::vector<Row> Take() {
    std::sort(rows_.begin(), rows_.end(),
              [this](const Row& a, const Row& b) { return IsBefore(a, b); });
    return std::move(rows_);
  }

 private:
  bool IsBefore(const Row& a, const Row& b) const {
    const auto key = [](const Row& row) { return std::tie(row.key.text, row.key.number); };
    if (key(a) != key(b)) return descending_ ? key(b) < key(a) : key(a) < key(b);
    return a.session.id < b.session.id;
  }

  const bool descending_;
  const size_t limit_;
  std::vector<Row> rows_;  // a heap, the last row at its front
};

// Returns true if the id, "policy/version", "tenant=name" or a "key=value" label of the session
// contains the text, ignoring case.
bool Matches(const ListedSession& listed, const SessionOptions& options,
             absl::string_view lower_case) {
  const auto holds = [&](absl::string_view text) {
    return absl::StrContains(absl::AsciiStrToLower(text), lower_case);
  };
  if (lower_case.empty() || holds(listed.id)) return true;
  if (holds(absl::StrCat(options.policy, "/", options.version))) return true;
  if (holds(absl::StrCat("tenant=", options.tenant))) return true;
  return std::any_of(options.labels.begin(), options.labels.end(), [&](const auto& label) {
    return holds(absl::StrCat(label.first, "=", label.second));
  });
}

}  // namespace

absl::StatusOr<std::string> StatusJson(const std::vector<prometheus::MetricFamily>& families,
                                       const v1::ListPoliciesResponse& policies,
                                       const v1::ListRolloutsResponse& rollouts,
                                       const ServerStatus& server) {
  const auto policies_json = MessageToJson(policies);
  if (!policies_json.ok()) return policies_json.status();
  const auto rollouts_json = MessageToJson(rollouts);
  if (!rollouts_json.ok()) return rollouts_json.status();
  Json status = {{"time", server.time},       {"version", std::string(Version())},
                 {"serving", server.serving}, {"store", server.store},
                 {"replica", server.replica}, {"replicas", server.replicas}};
  status["policies"] = Json::parse(*policies_json)["policies"];
  status["rollouts"] = Json::parse(*rollouts_json)["rollouts"];
  for (const prometheus::MetricFamily& family : families) {
    Json& series = status["metrics"][family.name] = Json::array();
    for (const auto& metric : family.metric) series.push_back(SeriesToJson(metric, family.type));
  }
  return status.dump();
}

absl::StatusOr<std::string> SessionsJson(SessionStore& store, const Credential& caller,
                                         const HttpQuery& query) {
  const auto order = OrderOf(query);
  if (!order.ok()) return order.status();
  const auto offset = query.GetInteger("offset", 0, 0, INT64_MAX - kLargestLimit);
  if (!offset.ok()) return offset.status();
  const auto limit = query.GetInteger("limit", kDefaultLimit, 1, kLargestLimit);
  if (!limit.ok()) return limit.status();

  // One list at a time, so that many readers together take no more memory and time than one.
  static absl::Mutex one_at_a_time(absl::kConstInit);
  absl::MutexLock turn(&one_at_a_time);
  const std::string filter = absl::AsciiStrToLower(query.Get("filter"));
  int64_t open = 0;
  int64_t matching = 0;
  FirstRows first(order->descending, static_cast<size_t>(*offset + *limit));
  const auto visit = [&](const ListedSession& listed) {
    ++open;
    SessionEntry& entry = *listed.entry;
    absl::MutexLock lock(&entry.mutex);
    if (!Matches(listed, entry.agent.session().options, filter)) return;
    ++matching;
    first.Add({.key = order->key(listed, entry.agent), .session = listed});
  };
  store.ForEach([&](const SessionEntry& entry) { return caller.CanRead(entry.tenant); }, visit);

  const std::vector<Row> rows = first.Take();
  v1::ListSessionsResponse page;
  for (size_t i = static_cast<size_t>(*offset); i < rows.size(); ++i) {
    ToProto(rows[i].session, page.add_sessions());
  }
  const auto page_json = MessageToJson(page);
  if (!page_json.ok()) return page_json.status();
  return Json{
      {"open", open}, {"matching", matching}, {"sessions", Json::parse(*page_json)["sessions"]}}
      .dump();
}

std::string ErrorJson(const absl::Status& status) {
  return Json{{"code", absl::StatusCodeToString(status.code())},
              {"message", std::string(status.message())}}
      .dump(-1, ' ', false, Json::error_handler_t::replace);
}

}  // namespace spikeserve
