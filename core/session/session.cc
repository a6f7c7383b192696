#include "core/session/session.h"

#include <algorithm>
#include <cmath>
#include <concepts>
#include <limits>
#include <tuple>
#include <type_traits>
#include <utility>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/model/json.h"
#include "nlohmann/json.hpp"

// Every struct is an array of its fields in the order of VisitFields, so that names do not outweigh
// numbers; writer and reader share that list. Numbers are exact: CBOR keeps the bits of a double,
// and every float is one.

namespace spikeserve {
namespace {

using Json = nlohmann::json;

constexpr char kFormat[] = "spikeserve.session.v1";
constexpr int kMaxDepth = 8;

// `visit(name, member)` for every member in turn; `T` is S or const S.
template <typename T, typename S>
concept Is = std::same_as<std::remove_const_t<T>, S>;

template <Is<Action> T, typename Visitor>
void VisitFields(T& action, Visitor&& visit) {
  visit("discrete", action.discrete);
  visit("continuous", action.continuous);
}

template <Is<Timestep> T, typename Visitor>
void VisitFields(T& timestep, Visitor&& visit) {
  visit("return_to_go", timestep.return_to_go);
  visit("observation", timestep.observation);
  visit("action", timestep.action);
}

template <Is<Counts> T, typename Visitor>
void VisitFields(T& counts, Visitor&& visit) {
  visit("spikes_by_stage", counts.spikes_by_stage);
  visit("accumulates", counts.accumulates);
  visit("multiply_accumulates", counts.multiply_accumulates);
  visit("attention_products", counts.attention_products);
}

template <Is<Answer> T, typename Visitor>
void VisitFields(T& answer, Visitor&& visit) {
  visit("step", answer.step);
  visit("action", answer.action);
  visit("probabilities", answer.probabilities);
  visit("return_to_go", answer.return_to_go);
  visit("counts", answer.counts);
  visit("compute_seconds", answer.compute_seconds);
  visit("logits", answer.logits);
}

template <Is<ActionSelection> T, typename Visitor>
void VisitFields(T& selection, Visitor&& visit) {
  visit("sample", selection.sample);
  visit("temperature", selection.temperature);
}

template <Is<LearningOptions> T, typename Visitor>
void VisitFields(T& options, Visitor&& visit) {
  visit("scope", options.scope);
  visit("rule", options.rule);
  visit("modulator", options.modulator);
  visit("learning_rate", options.learning_rate);
  visit("trace_decay", options.trace_decay);
  visit("discount", options.discount);
  visit("clip", options.clip);
  visit("max_drift", options.max_drift);
  visit("guard_margin", options.guard_margin);
}

template <Is<ReturnStatistics> T, typename Visitor>
void VisitFields(T& statistics, Visitor&& visit) {
  visit("mean", statistics.mean);
  visit("variance", statistics.variance);
  visit("decisions", statistics.decisions);
}

template <Is<EpisodeReturns> T, typename Visitor>
void VisitFields(T& episode, Visitor&& visit) {
  visit("decisions", episode.decisions);
  visit("rewards", episode.rewards);
  visit("returns", episode.returns);
  visit("squares", episode.squares);
  visit("weights", episode.weights);
  visit("weights2", episode.weights2);
  visit("projected", episode.projected);
}

template <Is<WindowLevel> T, typename Visitor>
void VisitFields(T& level, Visitor&& visit) {
  visit("mean", level.mean);
  visit("error", level.error);
}

template <Is<ReturnGuard> T, typename Visitor>
void VisitFields(T& guard, Visitor&& visit) {
  visit("returns", guard.returns);
  visit("beginning", guard.beginning);
  visit("good", guard.good);
  visit("has_reference", guard.has_reference);
  visit("reference", guard.reference);
  visit("last", guard.last);
  visit("on_probation", guard.on_probation);
  visit("rollbacks", guard.rollbacks);
}

template <Is<Learner> T, typename Visitor>
void VisitFields(T& learner, Visitor&& visit) {
  visit("head_delta", learner.head_delta);
  visit("returns", learner.returns);
  visit("guard", learner.guard);
  visit("trace", learner.trace.values);
  visit("episode", learner.episode);
  visit("trace_sum", learner.trace_sum);
  visit("discounted_trace", learner.discounted_trace);
  visit("credit", learner.credit);
  visit("updates", learner.updates);
  visit("rejected", learner.rejected);
  visit("suspended", learner.suspended);
}

template <Is<EpisodeEnd> T, typename Visitor>
void VisitFields(T& end, Visitor&& visit) {
  visit("reward", end.reward);
  visit("terminated", end.terminated);
  visit("target_return", end.target_return);
  visit("truncated", end.truncated);
  visit("observation", end.observation);
}

template <Is<LearningSummary> T, typename Visitor>
void VisitFields(T& summary, Visitor&& visit) {
  visit("scope", summary.scope);
  visit("updates", summary.updates);
  visit("rejected", summary.rejected);
  visit("head_drift", summary.head_drift);
  visit("returns", summary.returns);
  visit("rolled_back", summary.rolled_back);
  visit("watched_return", summary.watched_return);
}

template <Is<EpisodeSummary> T, typename Visitor>
void VisitFields(T& summary, Visitor&& visit) {
  visit("episode_return", summary.episode_return);
  visit("steps", summary.steps);
  visit("spikes", summary.spikes);
  visit("energy_joules", summary.energy_joules);
  visit("learning", summary.learning);
}

template <Is<EndedEpisode> T, typename Visitor>
void VisitFields(T& ended, Visitor&& visit) {
  visit("end", ended.end);
  visit("summary", ended.summary);
}

template <Is<SessionOptions> T, typename Visitor>
void VisitFields(T& options, Visitor&& visit) {
  visit("policy", options.policy);
  visit("version", options.version);
  visit("target_return", options.target_return);
  visit("seed", options.seed);
  visit("action_selection", options.action_selection);
  visit("labels", options.labels);
  visit("tenant", options.tenant);
  visit("learning", options.learning);
  visit("head_delta", options.head_delta);
}

template <Is<Session> T, typename Visitor>
void VisitFields(T& session, Visitor&& visit) {
  visit("id", session.id);
  visit("options", session.options);
  visit("episode", session.episode);
  visit("step", session.step);
  visit("target_return", session.target_return);
  visit("return_to_go", session.return_to_go);
  visit("episode_return", session.episode_return);
  visit("episode_spikes", session.episode_spikes);
  visit("episode_energy_joules", session.episode_energy_joules);
  visit("history", session.history);
  visit("last_answer", session.last_answer);
  visit("last_end", session.last_end);
  visit("decisions", session.decisions);
  visit("spikes", session.spikes);
  visit("energy_joules", session.energy_joules);
  visit("learner", session.learner);
}

template <typename T>
concept HasFields = requires(T& value) {
  VisitFields(value, [](const char*, auto&) {});
};

// Writing.

template <typename T>
Json Write(const T& value) {
  return value;
}

template <typename T>
requires std::is_enum_v<T> Json Write(const T& value) { return std::string(ToString(value)); }

template <HasFields T>
Json Write(const T& value);

Json Write(const History& history) {
  Json json = Json::array();
  for (size_t i = 0; i < history.size(); ++i) json.push_back(Write(history.at(i)));
  return json;
}

template <typename T>
Json Write(const std::optional<T>& value) {
  return value.has_value() ? Write(*value) : Json();
}

template <typename T>
Json Write(const std::shared_ptr<const T>& value) {
  return value != nullptr ? Write(*value) : Json();
}

template <HasFields T>
Json Write(const T& value) {
  Json json = Json::array();
  VisitFields(value, [&](const char*, const auto& member) { json.push_back(Write(member)); });
  return json;
}

// Reading: the first thing that is wrong becomes the status, named by its path.

class Reader {
 public:
  const absl::Status& status() const { return status_; }

  void Read(const Json& json, const std::string& path, std::string& value) {
    if (!json.is_string()) return Fail(path, "a string", json);
    value = json.get<std::string>();
  }

  void Read(const Json& json, const std::string& path, bool& value) {
    if (!json.is_boolean()) return Fail(path, "a boolean", json);
    value = json.get<bool>();
  }

  template <typename T>
  requires std::is_enum_v<T>
  void Read(const Json& json, const std::string& path, T& value) {
    if (!json.is_string() || !FromString(json.get<std::string>(), &value)) {
      Fail(path, "a name of its values", json);
    }
  }

  template <std::integral T>
  void Read(const Json& json, const std::string& path, T& value) {
    const bool fits = json.is_number_unsigned()  ? std::in_range<T>(json.get<uint64_t>())
                      : json.is_number_integer() ? std::in_range<T>(json.get<int64_t>())
                                                 : false;
    if (!fits) return Fail(path, absl::StrCat("an integer of ", 8 * sizeof(T), " bits"), json);
    value = json.get<T>();
  }

  template <std::floating_point T>
  void Read(const Json& json, const std::string& path, T& value) {
    const double number = json.is_number_float() ? json.get<double>() : std::nan("");
    if (!(std::abs(number) <= static_cast<double>(std::numeric_limits<T>::max()))) {
      return Fail(path, "a finite floating-point number", json);
    }
    value = static_cast<T>(number);
  }

  template <typename T, size_t N>
  void Read(const Json& json, const std::string& path, std::array<T, N>& values) {
    if (!json.is_array() || json.size() != N) {
      return Fail(path, absl::StrCat("an array of ", N), json);
    }
    for (size_t i = 0; i < N; ++i) Read(json[i], absl::StrCat(path, "[", i, "]"), values[i]);
  }

  template <typename T>
  void Read(const Json& json, const std::string& path, std::vector<T>& values) {
    if (!json.is_array()) return Fail(path, "an array", json);
    values.resize(json.size());
    for (size_t i = 0; i < json.size(); ++i) {
      Read(json[i], absl::StrCat(path, "[", i, "]"), values[i]);
    }
  }

  void Read(const Json& json, const std::string& path, History& history) {
    std::vector<Timestep> timesteps;
    Read(json, path, timesteps);
    for (size_t i = 0; i < timesteps.size(); ++i) {
      const auto& [return_to_go, observation, action] = timesteps[i];
      if (observation.size() != timesteps[0].observation.size() ||
          action.continuous.size() != timesteps[0].action.continuous.size()) {
        return Fail(absl::StrCat(path, "[", i, "]"), "as many numbers as timestep 0 has", json[i]);
      }
      history.Append(return_to_go, observation, action, timesteps.size());
    }
  }

  void Read(const Json& json, const std::string& path, std::map<std::string, std::string>& values) {
    if (!json.is_object()) return Fail(path, "a map", json);
    for (const auto& [key, value] : json.items()) Read(value, path, values[key]);
  }

  template <typename T>
  void Read(const Json& json, const std::string& path, std::optional<T>& value) {
    if (!json.is_null()) Read(json, path, value.emplace());
  }

  template <typename T>
  void Read(const Json& json, const std::string& path, std::shared_ptr<const T>& value) {
    if (json.is_null()) return;
    auto read = std::make_shared<T>();
    Read(json, path, *read);
    value = std::move(read);
  }

  template <HasFields T>
  void Read(const Json& json, const std::string& path, T& value) {
    size_t fields = 0;
    VisitFields(value, [&](const char*, auto&) { ++fields; });
    if (!json.is_array() || json.size() != fields) {
      return Fail(path, absl::StrCat("an array of ", fields), json);
    }
    size_t i = 0;
    VisitFields(value, [&](const char* name, auto& member) {
      Read(json[i++], absl::StrCat(path, ".", name), member);
    });
  }

 private:
  void Fail(const std::string& path, absl::string_view expected, const Json& received) {
    status_.Update(absl::InvalidArgumentError(
        absl::StrCat(path, ": expected ", expected, ", received ", Describe(received))));
  }

  absl::Status status_;
};

// Refuses what is nested deeper than any session, before a recursive parser goes down there.
class DepthChecker : public nlohmann::json_sax<Json> {
 public:
  bool null() override { return true; }
  bool boolean(bool) override { return true; }
  bool number_integer(number_integer_t) override { return true; }
  bool number_unsigned(number_unsigned_t) override { return true; }
  bool number_float(number_float_t, const string_t&) override { return true; }
  bool string(string_t&) override { return true; }
  bool binary(binary_t&) override { return true; }
  bool key(string_t&) override { return true; }
  bool start_object(size_t) override { return ++depth_ <= kMaxDepth; }
  bool end_object() override { return --depth_, true; }
  bool start_array(size_t) override { return ++depth_ <= kMaxDepth; }
  bool end_array() override { return --depth_, true; }
  bool parse_error(size_t, const std::string&, const nlohmann::detail::exception&) override {
    return false;
  }

 private:
  int depth_ = 0;
};

absl::Status Inconsistent(absl::string_view field, absl::string_view expected, int64_t received) {
  return absl::InvalidArgumentError(
      absl::StrCat("session.", field, ": expected ", expected, ", received ", received));
}

// What holds of every learner: one size for everything of the head's shape.
absl::Status CheckLearner(const LearningOptions& options, const Learner& learner) {
  const auto size = static_cast<int64_t>(learner.head_delta.size());
  const int64_t sums = options.modulator == Modulator::kRealized ? size : 0;
  const int64_t kept = options.scope == Scope::kSession ? size : 0;
  const std::tuple<const char*, size_t, int64_t> lengths[] = {
      {"learner.trace", learner.trace.values.size(), size},
      {"learner.trace_sum", learner.trace_sum.size(), sums},
      {"learner.discounted_trace", learner.discounted_trace.size(), sums},
      {"learner.credit", learner.credit.size(), sums},
      {"learner.guard.beginning", learner.guard.beginning.size(), kept},
      {"learner.guard.good", learner.guard.good.size(), kept}};
  for (const auto& [field, length, expected] : lengths) {
    if (static_cast<int64_t>(length) == expected) continue;
    return Inconsistent(field, absl::StrCat(expected, " numbers"), static_cast<int64_t>(length));
  }
  if (learner.guard.returns.size() >= ReturnGuard::kWindow) {
    return Inconsistent("learner.guard.returns", absl::StrCat("fewer than ", ReturnGuard::kWindow),
                        static_cast<int64_t>(learner.guard.returns.size()));
  }
  if (learner.returns.variance < 0.0) {
    return absl::InvalidArgumentError(
        absl::StrCat("session.learner.returns.variance: expected at least 0, received ",
                     learner.returns.variance));
  }
  return absl::OkStatus();
}

// What holds of every session between two requests.
absl::Status CheckInvariants(const Session& session) {
  if (session.options.version < 1) {
    return Inconsistent("options.version", "at least 1", session.options.version);
  }
  if (session.episode < 0) return Inconsistent("episode", "at least 0", session.episode);
  if (session.step < 0) return Inconsistent("step", "at least 0", session.step);
  const auto timesteps = static_cast<int64_t>(session.history.size());
  if (timesteps > session.step || (timesteps == 0 && session.step > 0)) {
    return Inconsistent("history", absl::StrCat("1 to ", session.step, " timesteps"), timesteps);
  }
  const int64_t last = session.last_answer.has_value() ? session.last_answer->step : -1;
  if (last != session.step - 1) {
    return Inconsistent("last_answer.step", absl::StrCat(session.step - 1), last);
  }
  if ((session.last_end != nullptr) != (session.episode > 0 && session.step == 0)) {
    return absl::InvalidArgumentError(
        "session.last_end: expected one if and only if an episode has ended and the next has not "
        "begun");
  }
  if (session.learner.has_value() != session.options.learning.has_value()) {
    return absl::InvalidArgumentError(
        "session.learner: expected one if and only if session.options.learning is set");
  }
  if (session.learner.has_value()) return CheckLearner(*session.options.learning, *session.learner);
  return absl::OkStatus();
}

}  // namespace

std::string SerializeSession(const Session& session) {
  std::string bytes;
  Json::to_cbor(Json::array({kFormat, Write(session)}), bytes);
  return bytes;
}

absl::StatusOr<Session> ParseSession(const std::string& bytes) {
  DepthChecker checker;
  if (!Json::sax_parse(bytes, &checker, Json::input_format_t::cbor)) {
    return absl::InvalidArgumentError(absl::StrCat("session: expected CBOR, received ",
                                                   bytes.size(), " bytes of something else"));
  }
  const Json json = Json::from_cbor(bytes);
  if (!json.is_array() || json.size() != 2 || json[0] != kFormat) {
    return absl::InvalidArgumentError(
        absl::StrCat("session: expected an array of \"", kFormat, "\" and the session, received ",
                     json.is_array() && !json.empty() ? Describe(json[0]) : Describe(json)));
  }
  Session session;
  Reader reader;
  reader.Read(json[1], "session", session);
  if (!reader.status().ok()) return reader.status();
  if (auto status = CheckInvariants(session); !status.ok()) return status;
  return session;
}

}  // namespace spikeserve
