#include "server/web/status_json.h"

#include <algorithm>
#include <cstdint>
#include <functional>
#include <map>
#include <utility>

#include "absl/strings/ascii.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "core/base/json.h"
#include "core/base/version.h"
#include "nlohmann/json.hpp"
#include "prometheus/metric_type.h"
#include "proto/json.h"
#include "server/admin/session_info.h"

namespace spikeserve {
namespace {

using Json = nlohmann::json;
using v1::SessionInfo;

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

// Compares two sessions by one column.
using Less = std::function<bool(const SessionInfo&, const SessionInfo&)>;

template <typename Field>
Less By(Field (SessionInfo::*field)() const) {
  return
      [field](const SessionInfo& a, const SessionInfo& b) { return (a.*field)() < (b.*field)(); };
}

double SpikesPerDecision(const SessionInfo& session) {
  const double decisions = static_cast<double>(std::max<uint64_t>(session.decisions(), 1));
  return static_cast<double>(session.spikes()) / decisions;
}

const std::map<std::string, Less>& Columns() {
  static const auto* const columns = new std::map<std::string, Less>{
      {"session_id", By(&SessionInfo::session_id)},
      {"policy",
       [](const SessionInfo& a, const SessionInfo& b) {
         return std::pair(a.policy(), a.version()) < std::pair(b.policy(), b.version());
       }},
      {"episode", By(&SessionInfo::episode)},
      {"step", By(&SessionInfo::step)},
      {"episode_return", By(&SessionInfo::episode_return)},
      {"decisions", By(&SessionInfo::decisions)},
      {"spikes_per_decision",
       [](const SessionInfo& a, const SessionInfo& b) {
         return SpikesPerDecision(a) < SpikesPerDecision(b);
       }},
      {"energy_joules", By(&SessionInfo::energy_joules)},
      {"head_drift", By(&SessionInfo::head_drift)},
      {"idle_seconds", By(&SessionInfo::idle_seconds)},
  };
  return *columns;
}

absl::StatusOr<Less> OrderOf(const HttpQuery& query) {
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
  if (order == "ascending") return column->second;
  if (order == "descending") {
    return Less(
        [less = column->second](const SessionInfo& a, const SessionInfo& b) { return less(b, a); });
  }
  return absl::InvalidArgumentError(
      absl::StrCat("order: expected ascending or descending, received ", Quoted(order)));
}

// Returns true if the id, "policy/version", "tenant=name" or a "key=value" label of the session
// contains the text, ignoring case.
bool Matches(const SessionInfo& session, absl::string_view lower_case) {
  const auto holds = [&](absl::string_view text) {
    return absl::StrContains(absl::AsciiStrToLower(text), lower_case);
  };
  if (holds(session.session_id())) return true;
  if (holds(absl::StrCat(session.policy(), "/", session.version()))) return true;
  if (holds(absl::StrCat("tenant=", session.tenant()))) return true;
  return std::any_of(session.labels().begin(), session.labels().end(), [&](const auto& label) {
    return holds(absl::StrCat(label.first, "=", label.second));
  });
}

}  // namespace

absl::StatusOr<std::string> StatusJson(const std::vector<prometheus::MetricFamily>& families,
                                       const v1::ListPoliciesResponse& policies,
                                       const v1::ListRolloutsResponse& rollouts, double time,
                                       bool serving) {
  const auto policies_json = MessageToJson(policies);
  if (!policies_json.ok()) return policies_json.status();
  const auto rollouts_json = MessageToJson(rollouts);
  if (!rollouts_json.ok()) return rollouts_json.status();
  Json status = {{"time", time}, {"version", std::string(Version())}, {"serving", serving}};
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
  const auto less = OrderOf(query);
  if (!less.ok()) return less.status();
  const auto offset = query.GetInteger("offset", 0, 0, INT64_MAX);
  if (!offset.ok()) return offset.status();
  const auto limit = query.GetInteger("limit", kDefaultLimit, 1, kLargestLimit);
  if (!limit.ok()) return limit.status();

  const std::string filter = absl::AsciiStrToLower(query.Get("filter"));
  const std::vector<ListedSession> visible =
      store.List([&](const SessionEntry& entry) { return caller.CanRead(entry.tenant); });
  std::vector<SessionInfo> matching;
  for (const ListedSession& listed : visible) {
    SessionInfo info;
    ToProto(listed, &info);
    if (Matches(info, filter)) matching.push_back(std::move(info));
  }
  std::stable_sort(matching.begin(), matching.end(), *less);

  const auto first = std::min<int64_t>(*offset, std::ssize(matching));
  const auto last = std::min<int64_t>(first + *limit, std::ssize(matching));
  v1::ListSessionsResponse page;
  for (int64_t i = first; i < last; ++i) *page.add_sessions() = matching[static_cast<size_t>(i)];
  const auto page_json = MessageToJson(page);
  if (!page_json.ok()) return page_json.status();
  return Json{{"open", visible.size()},
              {"matching", matching.size()},
              {"sessions", Json::parse(*page_json)["sessions"]}}
      .dump();
}

std::string ErrorJson(const absl::Status& status) {
  return Json{{"code", absl::StatusCodeToString(status.code())},
              {"message", std::string(status.message())}}
      .dump(-1, ' ', false, Json::error_handler_t::replace);
}

}  // namespace spikeserve
