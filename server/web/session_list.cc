#include "server/web/session_list.h"

#include <algorithm>
#include <cstdint>
#include <map>
#include <optional>
#include <tuple>
#include <utility>
#include <vector>

#include "absl/container/flat_hash_map.h"
#include "absl/strings/ascii.h"
#include "absl/strings/escaping.h"
#include "absl/strings/match.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/synchronization/mutex.h"
#include "absl/time/time.h"
#include "core/base/cbor.h"
#include "core/base/json.h"
#include "core/base/status_macros.h"
#include "core/engine/energy.h"
#include "core/session/session_id.h"
#include "proto/json.h"
#include "server/admin/session_info.h"
#include "server/agent/datagram_channels.h"
#include "server/metrics/policy_metrics.h"

namespace spikeserve {
namespace {

using nlohmann::ordered_json;

constexpr int64_t kDefaultPageSize = 50;
constexpr int64_t kLargestPageSize = 1000;

// What a session is sorted by.
struct SortKey {
  std::string text = {};
  double number = 0.0;
  bool missing = false;  // true: the session is listed last in both orders
};

using ColumnKey = SortKey (*)(absl::Duration idle, const AgentSession&);

template <auto Field>
SortKey Number(absl::Duration /*idle*/, const AgentSession& agent) {
  return {.number = static_cast<double>(agent.session().*Field)};
}

template <auto Return>
SortKey OfEpisodes(absl::Duration /*idle*/, const AgentSession& agent) {
  const SessionLife& life = agent.life();
  return {.number = (life.*Return)(), .missing = life.ended_episodes() == 0};
}

double SpikesPerDecision(const Session& session) {
  const double decisions = static_cast<double>(std::max<uint64_t>(session.decisions, 1));
  return static_cast<double>(session.spikes) / decisions;
}

// Returns how many elements of the last observation are far from the training data.
uint32_t UnusualOf(const Session& session) {
  return session.last_answer.has_value() ? session.last_answer->unusual_observations : 0;
}

// Returns the energy of the last decision, if the model applies to it.
std::optional<double> LastEnergy(EnergyModel model, const AgentSession& agent) {
  const auto& answer = agent.session().last_answer;
  if (!answer.has_value()) return std::nullopt;
  return EstimateEnergy(model, answer->counts, agent.policy().config);
}

// Orders by the model that leads. Figures of other models cannot be compared with its own.
SortKey EnergyKey(absl::Duration /*idle*/, const AgentSession& agent) {
  const std::optional<double> joules = LastEnergy(EnumNames(EnergyModel())[0].value, agent);
  return {.number = joules.value_or(0.0), .missing = !joules.has_value()};
}

const std::map<std::string, ColumnKey>& Columns() {
  using Idle = absl::Duration;
  using Agent = const AgentSession&;
  static const auto* const columns = new std::map<std::string, ColumnKey>{
      {"session_id", [](Idle, Agent) { return SortKey{}; }},  // equal keys are sorted by id
      {"policy",
       [](Idle, Agent agent) {
         const SessionOptions& options = agent.session().options;
         return SortKey{.text = options.policy, .number = static_cast<double>(options.version)};
       }},
      {"episode", Number<&Session::episode>},
      {"step", Number<&Session::step>},
      {"episode_return", Number<&Session::episode_return>},
      {"mean_return", OfEpisodes<&SessionLife::mean_return>},
      {"last_return", OfEpisodes<&SessionLife::last_return>},
      {"decisions", Number<&Session::decisions>},
      {"spikes_per_decision",
       [](Idle, Agent agent) { return SortKey{.number = SpikesPerDecision(agent.session())}; }},
      {"energy_joules", Number<&Session::energy_joules>},
      {"energy_joules_per_decision", EnergyKey},
      {"unusual_observations",
       [](Idle, Agent agent) {
         return SortKey{.number = static_cast<double>(UnusualOf(agent.session()))};
       }},
      {"needs_help",
       [](Idle, Agent agent) {
         const Help help = agent.NeedsHelp();
         return SortKey{.number = help.score(), .missing = !help.is_needed()};
       }},
      {"head_drift", [](Idle, Agent agent) { return SortKey{.number = agent.HeadDrift()}; }},
      {"idle_seconds",
       [](Idle idle, Agent) { return SortKey{.number = absl::ToDoubleSeconds(idle)}; }},
  };
  return *columns;
}

// The place of a session in a list.
struct ListPlace {
  SortKey key;
  std::string id;
};

// The order of a list of sessions.
struct Order {
  std::string column;
  ColumnKey column_key;
  bool descending;
  bool by_id;  // the column is "session_id"

  // Takes the lock of the session, except for its id.
  SortKey KeyOf(const ListedSession& listed) const {
    if (by_id) return {};
    absl::MutexLock lock(&listed.entry->mutex);
    return column_key(listed.idle, listed.entry->agent);
  }

  // The order of the store, which lists it without looking into the sessions.
  bool IsByIdAscending() const { return by_id && !descending; }

  bool IsBefore(const SortKey& a, absl::string_view a_id, const SortKey& b,
                absl::string_view b_id) const {
    if (a.missing != b.missing) return b.missing;
    const auto x = std::tie(a.text, a.number);
    const auto y = std::tie(b.text, b.number);
    if (x != y) return descending ? y < x : x < y;
    return by_id && descending ? b_id < a_id : a_id < b_id;
  }
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
    return Order{.column = sort,
                 .column_key = column->second,
                 .descending = order == "descending",
                 .by_id = sort == "session_id"};
  }
  return absl::InvalidArgumentError(
      absl::StrCat("order: expected ascending or descending, received ", Quoted(order)));
}

// A page token is the place of the last session of the page before, as CBOR in base64. It names
// the order, because places of different orders cannot be compared.
std::string TokenOf(const ListPlace& place, const Order& order) {
  const auto cbor = ordered_json::to_cbor({order.column, order.descending, place.key.text,
                                           place.key.number, place.key.missing, place.id});
  return absl::WebSafeBase64Escape(std::string(cbor.begin(), cbor.end()));
}

absl::StatusOr<std::optional<ListPlace>> PlaceOf(const std::string& token, const Order& order) {
  if (token.empty()) return std::optional<ListPlace>();
  std::string cbor;
  nlohmann::json parts;
  if (absl::WebSafeBase64Unescape(token, &cbor)) parts = ParseCbor(cbor).value_or(nullptr);
  const bool valid = parts.is_array() && parts.size() == 6 && parts[0] == order.column &&
                     parts[1] == order.descending && parts[2].is_string() && parts[3].is_number() &&
                     parts[4].is_boolean() && parts[5].is_string();
  if (!valid) {
    return absl::InvalidArgumentError(
        absl::StrCat("page_token: expected the next_page_token of a list with the same sort and "
                     "order, received ",
                     Quoted(token)));
  }
  return ListPlace{.key = {.text = parts[2], .number = parts[3], .missing = parts[4]},
                   .id = parts[5]};
}

// A session in a list.
struct Row {
  SortKey key;
  ListedSession session;
};

// Keeps the first `limit` rows in an order.
class FirstRows {
 public:
  FirstRows(const Order& order, size_t limit) : order_(order), limit_(limit) {}

  // Copies the session only if it is one of the first so far.
  void Add(SortKey key, const ListedSession& session) {
    const auto before = [this](const Row& a, const Row& b) { return IsBefore(a, b); };
    if (rows_.size() == limit_) {
      const Row& last = rows_.front();
      if (!order_.IsBefore(key, session.id, last.key, last.session.id)) return;
      std::pop_heap(rows_.begin(), rows_.end(), before);
      rows_.pop_back();
    }
    rows_.push_back({.key = std::move(key), .session = session});
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
    return order_.IsBefore(a.key, a.session.id, b.key, b.session.id);
  }

  const Order& order_;
  const size_t limit_;
  std::vector<Row> rows_;  // a heap, the last row at its front
};

// Selects the sessions of which the id, "policy/version", "tenant=name" or a "key=value" label
// contains a text, ignoring case. Many sessions have the same policy and tenant, so their texts are
// searched once. Takes no lock of a session. Not thread-safe.
class Filter {
 public:
  explicit Filter(absl::string_view text)
      : lower_case_(absl::AsciiStrToLower(text)),
        may_be_in_label_(!absl::StrContains(text, kLabelEnd)) {}

  bool Matches(const ListedSession& listed) {
    const SessionEntry& entry = *listed.entry;
    if (lower_case_.empty() || Holds(listed.id)) return true;
    if (may_be_in_label_ && absl::StrContains(entry.label_text, lower_case_)) return true;
    const auto [policy, new_policy] = policies_.try_emplace(entry.served);
    if (new_policy) {
      policy->second = Holds(entry.served->name, "/", entry.served->version);
    }
    if (policy->second) return true;
    const auto [tenant, new_tenant] = tenants_.try_emplace(entry.tenant);
    if (new_tenant) tenant->second = Holds("tenant=", entry.tenant);
    return tenant->second;
  }

 private:
  // Returns whether the pieces together contain the text.
  template <typename... Pieces>
  bool Holds(const Pieces&... pieces) {
    text_.clear();
    absl::StrAppend(&text_, pieces...);
    absl::AsciiStrToLower(&text_);
    return absl::StrContains(text_, lower_case_);
  }

  const std::string lower_case_;
  const bool may_be_in_label_;
  std::string text_;  // reused, so that it is allocated once
  absl::flat_hash_map<std::shared_ptr<const ServedPolicy>, bool> policies_;
  absl::flat_hash_map<std::string, bool> tenants_;
};

// What a request for a list selects.
struct ListSelection {
  int64_t open = 0;      // sessions that the caller may read
  int64_t matching = 0;  // those of them that match the filter
  std::vector<Row> rows;
};

// Selects sessions in the order of the store, without taking their locks.
ListSelection FirstById(SessionStore& store, const Credential& caller,
                        const std::optional<ListPlace>& after, size_t limit) {
  ListSelection found;
  const auto wanted = [&](const SessionEntry& entry) {
    const bool readable = caller.CanRead(entry.tenant);
    found.open += readable ? 1 : 0;
    return readable;
  };
  auto sessions = store.ListAfter(after.has_value() ? after->id : "", limit, wanted);
  for (ListedSession& session : sessions) {
    found.rows.push_back({.key = {}, .session = std::move(session)});
  }
  found.matching = found.open;
  return found;
}

ListSelection FirstInOrder(SessionStore& store, const Credential& caller, const std::string& text,
                           const Order& order, const std::optional<ListPlace>& after,
                           size_t limit) {
  ListSelection found;
  FirstRows first(order, limit);
  Filter filter(text);
  const auto visit = [&](const ListedSession& listed) {
    ++found.open;
    if (!filter.Matches(listed)) return;
    ++found.matching;
    SortKey key = order.KeyOf(listed);
    if (after.has_value() && !order.IsBefore(after->key, after->id, key, listed.id)) return;
    first.Add(std::move(key), listed);
  };
  store.ForEach([&](const SessionEntry& entry) { return caller.CanRead(entry.tenant); }, visit);
  found.rows = first.Take();
  return found;
}

// Returns a SessionInfo as JSON, with the returns of the ended episodes.
ordered_json InfoJson(const ListedSession& listed) {
  v1::SessionInfo info;
  ToProto(listed, &info);
  ordered_json json = MessageToFields(info, Numbers::kMapped, Absent::kNull);
  if (info.has_hold()) json["hold"] = absl::StrCat(info.hold().id(), ": ", info.hold().reason());
  absl::MutexLock lock(&listed.entry->mutex);
  const SessionLife& life = listed.entry->agent.life();
  const bool ended = life.ended_episodes() > 0;
  json["ended_episodes"] = life.ended_episodes();
  json["mean_return"] = ended ? ordered_json(life.mean_return()) : ordered_json();
  json["last_return"] = ended ? ordered_json(life.last_return()) : ordered_json();
  json["unusual_observations"] = UnusualOf(listed.entry->agent.session());
  ordered_json& energies = json["energy_joules_per_decision"] = ordered_json::object();
  for (const auto& [model, name] : EnumNames(EnergyModel())) {
    const auto joules = LastEnergy(model, listed.entry->agent);
    if (joules.has_value()) energies[std::string(name)] = *joules;
  }
  return json;
}

// Returns the elements of the last observation with what the training data were like.
ordered_json ObservationJson(const Session& session, const Policy& policy,
                             double unusual_deviations) {
  ordered_json elements = ordered_json::array();
  if (!session.last_answer.has_value()) return elements;
  const auto usual = UsualObservations::Of(policy, unusual_deviations);
  const auto observation = session.history.observation(session.history.size() - 1);
  const std::vector<Feature>& features = policy.features.observation;
  for (size_t i = 0; i < observation.size(); ++i) {
    const bool bounded = i < usual.low.size();
    elements.push_back({{"name", i < features.size() ? features[i].name : ""},
                        {"unit", i < features.size() ? features[i].unit : ""},
                        {"value", observation[i]},
                        {"mean", policy.weights.observation_mean.values[i]},
                        {"deviation", policy.weights.observation_std.values[i]},
                        {"low", bounded ? ordered_json(usual.low[i]) : ordered_json()},
                        {"high", bounded ? ordered_json(usual.high[i]) : ordered_json()},
                        {"unusual", bounded && !(observation[i] >= usual.low[i] &&
                                                 observation[i] <= usual.high[i])}});
  }
  return elements;
}

}  // namespace

absl::StatusOr<std::string> SessionsJson(SessionStore& store, const Credential& caller,
                                         const HttpQuery& query) {
  ASSIGN_OR_RETURN(const auto order, OrderOf(query));
  ASSIGN_OR_RETURN(const auto page_size,
                   query.GetInteger("page_size", kDefaultPageSize, 1, kLargestPageSize));
  ASSIGN_OR_RETURN(const auto after, PlaceOf(query.Get("page_token"), order));

  const std::string filter = query.Get("filter");
  const auto limit = static_cast<size_t>(page_size);
  // One more than the page, which shows whether there is another one.
  ListSelection found = filter.empty() && order.IsByIdAscending()
                            ? FirstById(store, caller, after, limit + 1)
                            : FirstInOrder(store, caller, filter, order, after, limit + 1);
  std::vector<Row>& rows = found.rows;
  std::string next;
  if (rows.size() > limit) {
    rows.resize(limit);
    next = TokenOf({.key = rows.back().key, .id = rows.back().session.id}, order);
  }
  ordered_json sessions = ordered_json::array();
  for (const Row& row : rows) sessions.push_back(InfoJson(row.session));
  return JsonText({{"open", found.open},
                   {"matching", found.matching},
                   {"sessions", std::move(sessions)},
                   {"next_page_token", next}});
}

absl::StatusOr<std::string> SessionJson(SessionStore& store, const Credential& caller,
                                        const std::string& id, double unusual_deviations) {
  const std::optional<ListedSession> found = store.PeekListed(id, caller.tenant()->name());
  if (!found.has_value() || !caller.CanRead(found->entry->tenant)) return NoSuchSession(id);
  ordered_json json = InfoJson(*found);

  SessionEntry& entry = *found->entry;
  absl::MutexLock lock(&entry.mutex);
  const Session& session = entry.agent.session();
  json["target_return"] = session.target_return;
  json["return_to_go"] = session.return_to_go;
  const auto& learning = session.options.learning;
  json["learns"] =
      learning.has_value() ? ordered_json(std::string(ToString(learning->scope))) : ordered_json();
  json["environment"] = entry.served->policy().environment;
  json["observation"] = ObservationJson(session, entry.served->policy(), unusual_deviations);
  const auto& source = entry.agent.life().last_source();
  json["last_source"] = source.has_value() ? ordered_json(ToString(*source)) : ordered_json();
  json["transport"] = DatagramChannels::CarriesSteps(entry) ? "datagrams" : "gRPC";
  const auto& verdict = session.wiring.verdict;
  json["wiring"] = verdict.has_value() ? ordered_json(WiringText(entry.served->policy(), *verdict))
                                       : ordered_json();
  json["age_seconds"] = absl::ToDoubleSeconds(entry.agent.Age());
  ordered_json& decisions = json["history"]["decisions"] = ordered_json::array();
  for (const auto& [first, count, sum] : entry.agent.life().decisions()) {
    const auto n = static_cast<double>(count);
    decisions.push_back({{"first", first},
                         {"count", count},
                         {"until_seconds", sum.until},
                         {"spikes_per_decision", sum.spikes / n},
                         {"mean_seconds", sum.seconds / n}});
  }
  ordered_json& episodes = json["history"]["episodes"] = ordered_json::array();
  for (const auto& [first, count, sum] : entry.agent.life().episodes()) {
    episodes.push_back({{"first", first},
                        {"count", count},
                        {"mean_return", sum.episode_return / static_cast<double>(count)}});
  }
  return JsonText(json);
}

}  // namespace spikeserve
