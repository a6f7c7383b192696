#include "server/metrics/metrics.h"

#include <algorithm>
#include <iterator>
#include <optional>
#include <sstream>
#include <utility>

#include "absl/algorithm/container.h"
#include "absl/strings/str_cat.h"
#include "core/base/version.h"
#include "core/engine/account.h"
#include "prometheus/text_serializer.h"
#include "server/base/log.h"
#include "server/metrics/process_metrics.h"

namespace spikeserve {
namespace {

using prometheus::BuildCounter;
using prometheus::BuildGauge;
using prometheus::BuildHistogram;
using Buckets = prometheus::Histogram::BucketBoundaries;

Buckets ComputeSeconds() {
  return {5e-6, 1e-5, 2.5e-5, 5e-5, 1e-4, 2.5e-4, 5e-4, 1e-3, 2.5e-3, 5e-3, 1e-2, 2.5e-2, 0.1};
}

Buckets RpcSeconds() {
  Buckets buckets = ComputeSeconds();
  buckets.insert(buckets.end(), {0.25, 1.0, 2.5, 10.0});
  return buckets;
}

Buckets RobotSeconds() {
  return {1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 60};
}

Buckets Spikes() { return {10, 25, 50, 100, 200, 350, 500, 1000, 2000, 3500, 5000, 10000, 100000}; }

// Covers both signs: tasks that give a negative reward for each step have negative returns.
Buckets Returns() {
  return {-2000, -1000, -500, -300, -200, -150, -120, -100, -90, -80, -70, -60, -50,
          -20,   0,     20,   50,   100,  200,  300,  400,  450, 490, 500, 1000};
}

// Returns the labels of the time series that share the elements of an observation of length `size`:
// an index, or the first and the last index of a range. See PolicyMetrics::Handles.
std::vector<std::string> ElementNames(int size) {
  const int series = std::min(size, kUnusualSeries);
  const auto first_of = [&](int i) { return (i * size + series - 1) / series; };
  std::vector<std::string> names;
  for (int i = 0; i < series; ++i) {
    const int first = first_of(i);
    const int last = first_of(i + 1) - 1;
    names.push_back(first == last ? absl::StrCat(first) : absl::StrCat(first, "-", last));
  }
  return names;
}

// Returns the energy of a decision of the dense policy that has the sizes of a spiking one.
std::optional<double> DenseEnergy(EnergyModel model, const Policy& policy) {
  const ModelConfig& config = policy.config;
  if (config.is_dense()) return std::nullopt;
  const Counts counts = DenseBaselineCounts(config, config.state_inputs(policy.observation_size()),
                                            policy.action_space.size());
  return EstimateEnergy(model, counts, DenseBaseline(config));
}

prometheus::Labels With(const prometheus::Labels& labels, const char* label,
                        absl::string_view value) {
  prometheus::Labels more = labels;
  more.emplace(label, value);
  return more;
}

}  // namespace

Metrics::Metrics()
    : non_finite_(Register(BuildCounter(), "spikeserve_non_finite_answers_total",
                           "Answers that held NaN or infinity and were not sent. Without a "
                           "version: those of calls that make no decision.")),
      rpc_duration_(Register(
          BuildHistogram(), "spikeserve_rpc_duration_seconds",
          "Time to handle one call, measured on the server, by method and gRPC status code. For "
          "ActStream and ModelStreamInfer: one request on the stream. Act and ActStream also have "
          "the label policy, for the first 100 policies.")),
      reaped_idle_(Register(BuildCounter(), "spikeserve_sessions_reaped_total",
                            "Sessions that the server ended, by reason.")
                       .Add({{"reason", "idle"}})),
      sessions_limit_(Register(BuildGauge(), "spikeserve_sessions_limit",
                               "Limit on the open sessions of all policies together.")
                          .Add({})),
      recording_queue_episodes_(
          Register(BuildGauge(), "spikeserve_recording_queue_episodes",
                   "Recorded episodes that wait to be written. A crash loses them.")
              .Add({})),
      recording_queue_bytes_(Register(BuildGauge(), "spikeserve_recording_queue_bytes",
                                      "Memory of the recorded episodes that wait to be written.")
                                 .Add({})),
      rpc_durations_(AllMethods().size()) {
  auto& stored = Register(BuildGauge(), "spikeserve_stored_bytes",
                          "Bytes on the disk, measured each minute, by folder: recordings, in "
                          "--record_dir, and policies, in --policies.");
  auto& stored_limit = Register(BuildGauge(), "spikeserve_stored_bytes_limit",
                                "Limit on these bytes: --max_recorded_bytes, --max_policy_bytes.");
  static constexpr const char* kFolders[kStoredFolders] = {"recordings", "policies"};
  for (size_t i = 0; i < kStoredFolders; ++i) {
    stored_bytes_[i] = &stored.Add({{"folder", kFolders[i]}});
    stored_bytes_limit_[i] = &stored_limit.Add({{"folder", kFolders[i]}});
  }
  auto& recorded =
      Register(BuildCounter(), "spikeserve_recorded_episodes_total",
               "Episodes of recorded sessions, by outcome: written, queue_full, "
               "write_failed or storage_full. Episodes that are not written are lost.");
  static constexpr const char* kOutcomes[kRecordingOutcomes] = {"written", "queue_full",
                                                                "write_failed", "storage_full"};
  for (size_t i = 0; i < kRecordingOutcomes; ++i) {
    recorded_episodes_[i] = &recorded.Add({{"outcome", kOutcomes[i]}});
  }
  Register(BuildGauge(), "spikeserve_build_info", "1 for the running version.")
      .Add({{"version", std::string(Version())}})
      .Set(1);
}

// Adds series of a version, which are removed with it. A family is registered with its first one.
struct Metrics::Adder {
  prometheus::Registry& registry;
  VersionSeries& series;
  const prometheus::Labels& labels;

  // Returns the series with one label more, unless `label` is null.
  auto* Add(auto builder, const char* name, const char* help, const char* label,
            absl::string_view value, const auto&... buckets) const {
    auto& family = builder.Name(name).Help(help).Register(registry);
    auto* metric = &family.Add(label == nullptr ? labels : With(labels, label, value), buckets...);
    series.removals[metric] = [&family, metric] { family.Remove(metric); };
    return metric;
  }

  prometheus::Counter* counter(const char* name, const char* help, const char* label = nullptr,
                               absl::string_view value = "") const {
    return Add(BuildCounter(), name, help, label, value);
  }
  prometheus::Gauge* gauge(const char* name, const char* help, const char* label = nullptr,
                           absl::string_view value = "") const {
    return Add(BuildGauge(), name, help, label, value);
  }
  prometheus::Histogram* histogram(const char* name, const char* help,
                                   const Buckets& buckets) const {
    return Add(BuildHistogram(), name, help, nullptr, "", buckets);
  }
};

std::shared_ptr<SessionObserver> Metrics::NewPolicyObserver(const std::string& name,
                                                            int64_t version, const Policy& policy,
                                                            double unusual_deviations,
                                                            WiringResponse wiring) {
  const std::string key = absl::StrCat(name, "/", version);
  PolicySeries of = {.labels = {{"policy", name}, {"version", absl::StrCat(version)}},
                     .config = policy.config,
                     .elements = ElementNames(policy.observation_size()),
                     .features = policy.features.observation,
                     .checks_wiring = policy.wiring != nullptr,
                     .dense_energy = {}};
  for (size_t i = 0; i < kEnergyModels; ++i) {
    of.dense_energy[i] = DenseEnergy(static_cast<EnergyModel>(i), policy);
  }
  const prometheus::Labels info = With(of.labels, "environment", policy.environment);
  PolicyMetrics::LoadedHandles loaded;
  {
    absl::MutexLock lock(&versions_mutex_);
    VersionSeries& series = versions_[key];
    ++series.observers;
    loaded = {
        .info = Adder{registry_, series, info}.gauge(
            "spikeserve_policy_info",
            "Copies of a policy version in memory. The other series of a version begin with its "
            "first session, and all are removed when it is unloaded and its last session has "
            "ended.",
            "mode", ToString(policy.config.mode)),
        .non_finite = &non_finite_.Add(of.labels)};
    series.removals[loaded.non_finite] = [this, counter = loaded.non_finite] {
      non_finite_.Remove(counter);
    };
  }
  const prometheus::Labels labels = of.labels;
  return std::make_shared<PolicyMetrics>(
      key, loaded, EvidenceOf(name, version), policy.config, PlausibleReturns::Of(policy),
      UsualObservations::Of(policy, unusual_deviations), wiring,
      [this, key, of = std::move(of)] { return AddSessions(key, of); },
      [this, key, labels] { return AddRobots(key, labels); },
      [this, key, labels] { return AddSeats(key, labels); }, [this, key] { OnObserverEnd(key); });
}

PolicyMetrics::Handles Metrics::AddSessions(const std::string& version, const PolicySeries& of) {
  absl::MutexLock lock(&versions_mutex_);
  const Adder add = {registry_, versions_[version], of.labels};
  PolicyMetrics::Handles handles;
  handles.decisions =
      add.counter("spikeserve_decisions_total",
                  "Decisions computed. Retries are answered from storage and not counted.");
  handles.decision_duration = add.histogram(
      "spikeserve_decision_duration_seconds",
      "Time to compute one decision, without network and queueing.", ComputeSeconds());
  handles.sessions = add.gauge("spikeserve_sessions", "Open sessions.");
  handles.errors = add.counter("spikeserve_policy_errors_total",
                               "Decisions that were refused or failed, of open sessions.");
  handles.episodes = add.counter("spikeserve_episodes_total", "Ended episodes.");
  for (const auto& [source, name] : EnumNames(SourceKind())) {
    handles.steps[static_cast<size_t>(source)] = add.counter(
        "spikeserve_steps_total",
        "Executed actions of sessions, by who chose them: policy, operator, safety_layer, a "
        "fall-back of the robot (held, local, safe), hold, or unknown: the agent has executed "
        "another action than the answered one, and not said why.",
        "source", name);
  }
  handles.implausible = add.counter(
      "spikeserve_implausible_reports_total",
      "What agents report and cannot be true: more beats than fit into the time, and returns of "
      "episodes far beyond those of the policy. It counts nowhere else.");
  handles.episode_return = add.histogram(
      "spikeserve_episode_return",
      "Plausible return of each ended episode, in the environment's units.", Returns());
  handles.episode_return_mean =
      add.gauge("spikeserve_episode_return_mean",
                "Mean plausible return of the episodes that ended since the server started.");
  AddWork(add, of, &handles);
  AddUnusual(add, of, &handles);
  AddLearning(add, &handles);
  return handles;
}

void Metrics::AddWork(const Adder& add, const PolicySeries& of, PolicyMetrics::Handles* handles) {
  handles->spikes_per_decision = add.histogram(
      "spikeserve_spikes_per_decision", "Spikes of the new tokens of one decision.", Spikes());
  for (const auto& [stage, name] : EnumNames(Stage())) {
    handles->spikes[static_cast<size_t>(stage)] = add.counter(
        "spikeserve_spikes_total", "Spikes emitted, by neuron population.", "stage", name);
  }
  const auto synaptic = [&](const char* kind) {
    return add.counter(
        "spikeserve_synaptic_operations_total",
        "Effective synaptic operations as NeuroBench counts them: accumulate has a binary input, "
        "multiply_accumulate an analog one. Attention products are counted separately, as kind "
        "attention.",
        "kind", kind);
  };
  handles->accumulates = synaptic("accumulate");
  handles->multiply_accumulates = synaptic("multiply_accumulate");
  handles->attention_products = synaptic("attention");
  handles->membrane_updates = add.counter(
      "spikeserve_membrane_updates_total",
      "Updates of the membranes of LIF neurons: neurons times ticks, whether they fire or not.");
  const auto other = [&](const char* kind) {
    return add.counter(
        "spikeserve_other_operations_total",
        "Operations that are neither synaptic nor of membranes, by kind: coder_gain, "
        "layer_norm_element, softmax_term, gate_product.",
        "kind", kind);
  };
  handles->coder_gains = other("coder_gain");
  handles->layer_norm_elements = other("layer_norm_element");
  handles->softmax_terms = other("softmax_term");
  handles->gate_products = other("gate_product");
  handles->energy = {};
  for (const auto& [model, name] : EnumNames(EnergyModel())) {
    if (!Applies(model, of.config)) continue;
    const size_t i = static_cast<size_t>(model);
    handles->energy[i] = add.counter(
        "spikeserve_energy_joules_total",
        "Energy, estimated from counted events, not measured. The models are alternatives: do not "
        "add them. docs/reference/energy.md lists what each counts and leaves out. A policy to "
        "which a model does not apply has no series under it.",
        "energy_model", name);
    if (!of.dense_energy[i].has_value()) continue;
    add.gauge("spikeserve_dense_energy_joules",
              "Energy of a decision of a dense policy in integers with the sizes of this one and a "
              "full window, by the models that apply to both.",
              "energy_model", name)
        ->Set(*of.dense_energy[i]);
  }
}

void Metrics::AddUnusual(const Adder& add, const PolicySeries& of,
                         PolicyMetrics::Handles* handles) {
  const auto unusual = [&](const Adder& adder, absl::string_view element) {
    return adder.counter(
        "spikeserve_unusual_observations_total",
        "Elements of observations further than --unusual_deviations standard deviations from the "
        "mean of the training data, by index in the observation. Long observations are counted by "
        "ranges of indices. return_to_go: far beyond the policy's returns. `name` is the feature.",
        "element", element);
  };
  const bool are_named = of.features.size() == of.elements.size();
  for (size_t i = 0; i < of.elements.size(); ++i) {
    const prometheus::Labels named =
        are_named ? With(of.labels, "name", of.features[i].name) : of.labels;
    handles->unusual.push_back(unusual({add.registry, add.series, named}, of.elements[i]));
  }
  handles->unusual_return = unusual(add, "return_to_go");
  for (const auto& [cause, name] : EnumNames(WiringCause())) {
    if (!of.checks_wiring) break;
    handles->wiring[static_cast<size_t>(cause)] = add.counter(
        "spikeserve_wiring_verdicts_total",
        "Verdicts that the observations of a session are wired otherwise than those of the "
        "training data, by cause.",
        "cause", name);
  }
}

void Metrics::AddLearning(const Adder& add, PolicyMetrics::Handles* handles) {
  handles->learning_updates = add.counter("spikeserve_learning_updates_total",
                                          "Action-head updates applied by sessions that learn.");
  const auto rejected = [&](UpdateOutcome outcome) {
    return add.counter("spikeserve_learning_rejected_total",
                       "Action-head updates rejected; the head stays unchanged.", "reason",
                       ToString(outcome));
  };
  handles->learning_rejected_non_finite = rejected(UpdateOutcome::kNonFinite);
  handles->learning_rejected_over_budget = rejected(UpdateOutcome::kOverBudget);
  handles->learning_rejected_held_out = rejected(UpdateOutcome::kHeldOut);
  for (const Scope scope : {Scope::kSession, Scope::kFleet}) {
    const prometheus::Labels labels = With(add.labels, "scope", ToString(scope));
    const Adder of_scope = {add.registry, add.series, labels};
    handles->learning[static_cast<size_t>(scope)] = {
        .head_drift = of_scope.gauge(
            "spikeserve_head_drift_ratio",
            "|W - W_base| / |W_base| of the action head when the last learning episode ended. "
            "Scope session: the head of that session; scope fleet: the shared head."),
        .modulator_mean = of_scope.gauge(
            "spikeserve_modulator_mean",
            "mu of eq. 4.2: running mean of the returns that follow a decision, for the session "
            "whose learning episode ended last."),
        .modulator_std =
            of_scope.gauge("spikeserve_modulator_std",
                           "sigma of eq. 4.2: standard deviation of the returns whose mean is "
                           "spikeserve_modulator_mean."),
        .watched_return = of_scope.gauge(
            "spikeserve_learning_return",
            "Interquartile mean of the episode returns in the last complete window that a guard "
            "evaluated."),
        .rollbacks =
            of_scope.counter("spikeserve_learning_rollbacks_total",
                             "Rollbacks of an action head to its last good state by a guard.")};
  }
}

RobotHandles Metrics::AddRobots(const std::string& version, const prometheus::Labels& labels) {
  absl::MutexLock lock(&versions_mutex_);
  const Adder add = {registry_, versions_[version], labels};
  const auto beats = [&](const char* source) {
    return add.counter(
        "spikeserve_beats_total",
        "Beats of robots, as they report them, by the source of the action that was executed: "
        "fresh (an answer in time), held (the last action again), local (the engine on the robot) "
        "or safe.",
        "source", source);
  };
  const auto appended = [&](const char* known) {
    return add.counter(
        "spikeserve_appended_beats_total",
        "Beats that were appended to sessions without a decision, by what is known of them: "
        "observation, or reward alone.",
        "known", known);
  };
  return {
      .beats = {beats("fresh"), beats("held"), beats("local"), beats("safe")},
      .late_answers = add.counter("spikeserve_late_answers_total",
                                  "Answers that took longer than a period, as robots report. They "
                                  "may still have been fresh."),
      .cancelled_calls =
          add.counter("spikeserve_cancelled_calls_total",
                      "Requests that robots gave up or that failed, as robots report."),
      .reconnects = add.counter("spikeserve_robot_reconnects_total",
                                "Connections that robots opened in the place of one that did not "
                                "answer, as robots report."),
      .invalid_observations = add.counter(
          "spikeserve_invalid_observations_total",
          "Beats of robots without a valid observation, as they report them: its size was wrong or "
          "a number not finite. The robot executed a held or a safe action."),
      .appended = appended("observation"),
      .skipped = appended("reward"),
      .expired = add.counter("spikeserve_expired_requests_total",
                             "Requests that came too late for their answer to be of use."),
      .repeated = add.counter("spikeserve_repeated_requests_total",
                              "Requests for an answer that was given before: the first one was "
                              "late or lost."),
      .conflicting = add.counter("spikeserve_conflicting_requests_total",
                                 "Requests that repeat a step with another content, and were "
                                 "refused: two robots may use one session_id."),
      .missing_rewards =
          add.counter("spikeserve_missing_rewards_total",
                      "Rewards after step 0 that requests left out. They count as 0."),
      .age = add.histogram("spikeserve_action_age_seconds",
                           "Time from the observation to the execution of the oldest action that "
                           "a robot executed since its last report.",
                           RobotSeconds()),
      .gap = add.histogram("spikeserve_fresh_gap_seconds",
                           "Longest time of a robot without a fresh action since its last report.",
                           RobotSeconds())};
}

SeatHandles Metrics::AddSeats(const std::string& version, const prometheus::Labels& labels) {
  absl::MutexLock lock(&versions_mutex_);
  const Adder add = {registry_, versions_[version], labels};
  SeatHandles handles;
  for (const auto& [change, name] : EnumNames(SeatChange())) {
    handles[static_cast<size_t>(change)] = add.counter(
        "spikeserve_seat_changes_total",
        "Changes of who controls a session: an operator took it from the policy (taken) or from "
        "another operator (taken_over), returned it, or let the lease end (ended).",
        "change", name);
  }
  return handles;
}

VersionEvidence* Metrics::EvidenceOf(const std::string& name, int64_t version) {
  absl::MutexLock lock(&evidence_mutex_);
  std::unique_ptr<VersionEvidence>& evidence = evidence_[{name, version}];
  if (evidence == nullptr) evidence = std::make_unique<VersionEvidence>();
  return evidence.get();
}

void Metrics::OnObserverEnd(const std::string& version) {
  absl::MutexLock lock(&versions_mutex_);
  const auto found = versions_.find(version);
  if (--found->second.observers > 0 || keeps_series_) return;
  for (const auto& [series, remove] : found->second.removals) remove();
  versions_.erase(found);
}

void Metrics::KeepSeries() {
  absl::MutexLock lock(&versions_mutex_);
  keeps_series_ = true;
}

Metrics::RpcDurations* Metrics::DurationsOf(absl::string_view policy) {
  if (policy.empty()) return nullptr;
  {
    absl::ReaderMutexLock lock(&policies_mutex_);
    const auto found = policy_durations_.find(policy);
    if (found != policy_durations_.end()) return found->second.get();
    if (policy_durations_.size() >= kMostPolicies) return nullptr;
  }
  absl::MutexLock lock(&policies_mutex_);
  auto& durations = policy_durations_[policy];
  if (durations == nullptr) durations = std::make_unique<RpcDurations>(AllMethods().size());
  return durations.get();
}

void Metrics::ObserveRpc(const Method& method, absl::StatusCode code, absl::Duration duration,
                         absl::string_view policy) {
  RpcDurations* const of_policy = DurationsOf(policy);
  RpcDurations& durations = of_policy == nullptr ? rpc_durations_ : *of_policy;
  auto& slot = durations[method.index][static_cast<size_t>(code)];
  prometheus::Histogram* histogram = slot.load(std::memory_order_acquire);
  if (histogram == nullptr) {
    // Two threads may reach this at once; the family returns the same histogram to both. Abseil's
    // names of the codes are those of gRPC.
    prometheus::Labels labels = {{"method", method.name}, {"code", absl::StatusCodeToString(code)}};
    if (of_policy != nullptr) labels.emplace("policy", policy);
    histogram = &rpc_duration_.Add(labels, RpcSeconds());
    slot.store(histogram, std::memory_order_release);
  }
  histogram->Observe(absl::ToDoubleSeconds(duration));
}

void Metrics::CountNonFiniteAnswer(const std::string& policy) {
  non_finite_.Add({{"policy", policy}, {"version", ""}}).Increment();
  LogError("answer not finite", {{"policy", policy}});
}

std::vector<prometheus::MetricFamily> Metrics::Collect() const {
  std::vector<prometheus::MetricFamily> families = registry_.Collect();
  absl::c_move(CollectProcessMetrics(), std::back_inserter(families));
  for (const auto& source : sources_) absl::c_move(source(), std::back_inserter(families));
  return families;
}

std::string Metrics::ToText() const {
  std::ostringstream text;
  prometheus::TextSerializer().Serialize(text, Collect());
  return std::move(text).str();
}

}  // namespace spikeserve
