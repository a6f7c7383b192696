// Counts decisions, spikes, energy, episodes and learning of the sessions of one policy version,
// and logs each rollback by a guard.
//
// Thread-safe.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/base/call_once.h"
#include "absl/base/thread_annotations.h"
#include "absl/synchronization/mutex.h"
#include "absl/types/span.h"
#include "core/agent/served_policy.h"
#include "core/engine/energy.h"
#include "prometheus/counter.h"
#include "prometheus/gauge.h"
#include "prometheus/histogram.h"
#include "server/metrics/version_evidence.h"

namespace spikeserve {

// The range of each element of an observation, and of the return-to-go, that counts as usual.
struct UsualObservations {
  std::vector<float> low;  // [obs], in environment units; empty: every observation is usual
  std::vector<float> high;
  // The range of the return-to-go.
  double low_return = -std::numeric_limits<double>::infinity();
  double high_return = std::numeric_limits<double>::infinity();

  // Returns the ranges of `deviations` standard deviations on either side of the mean of the
  // training data, which the policy stores. The return-to-go is usual up to three return_scale
  // beyond return_offset and target_return: a policy stores no other trace of the returns that it
  // was trained on. 0: no ranges.
  static UsualObservations Of(const Policy& policy, double deviations);
};

// A value that is made when it is first needed. Thread-safe.
template <class Value>
class MadeOnce {
 public:
  explicit MadeOnce(std::function<Value()> make) : make_(std::move(make)) {}

  const Value& get() {
    absl::call_once(once_, [this] { value_ = make_(); });
    return value_;
  }

 private:
  const std::function<Value()> make_;
  absl::once_flag once_;
  Value value_;
};

// Time series about the robots of a policy version, as their links show it to the server.
struct RobotHandles {
  std::array<prometheus::Counter*, 4> beats;  // fresh, held, local, safe
  prometheus::Counter* late_answers;
  prometheus::Counter* cancelled_calls;
  prometheus::Counter* reconnects;
  prometheus::Counter* invalid_observations;  // beats
  prometheus::Counter* appended;              // beats
  prometheus::Counter* skipped;               // beats
  prometheus::Counter* expired;               // requests
  prometheus::Counter* repeated;              // requests
  prometheus::Counter* conflicting;           // requests
  prometheus::Counter* missing_rewards;
  prometheus::Histogram* age;
  prometheus::Histogram* gap;
};

// The changes of operators' control of a policy version's sessions, by SeatChange.
using SeatHandles = std::array<prometheus::Counter*, kSeatChanges>;

class PolicyMetrics final : public SessionObserver {
 public:
  // Time series of this policy version for one learning scope.
  struct LearningHandles {
    prometheus::Gauge* head_drift;
    prometheus::Gauge* modulator_mean;
    prometheus::Gauge* modulator_std;
    prometheus::Gauge* watched_return;
    prometheus::Counter* rollbacks;
  };
  // The time series that a version has from the start.
  struct LoadedHandles {
    prometheus::Gauge* info;
    prometheus::Counter* non_finite;  // its alert needs the 0 before the first count
  };
  // Time series of what sessions of this policy version do.
  struct Handles {
    prometheus::Counter* decisions;
    prometheus::Histogram* spikes_per_decision;
    std::array<prometheus::Counter*, kStages> spikes;
    prometheus::Counter* accumulates;
    prometheus::Counter* multiply_accumulates;
    prometheus::Counter* attention_products;
    prometheus::Counter* membrane_updates;
    prometheus::Counter* coder_gains;
    prometheus::Counter* layer_norm_elements;
    prometheus::Counter* softmax_terms;
    prometheus::Counter* gate_products;
    // Indexed by EnergyModel. Null for a model that does not apply to the policy.
    std::array<prometheus::Counter*, kEnergyModels> energy;
    prometheus::Histogram* decision_duration;
    prometheus::Gauge* sessions;
    prometheus::Counter* errors;
    prometheus::Counter* episodes;
    std::array<prometheus::Counter*, kSourceKinds> steps;  // by SourceKind
    prometheus::Counter* implausible;
    prometheus::Histogram* episode_return;
    prometheus::Gauge* episode_return_mean;
    // Element i of an observation of length n counts in series i * unusual.size() / n.
    std::vector<prometheus::Counter*> unusual;
    prometheus::Counter* unusual_return;
    // By WiringCause. Null if the policy has no model of its observations.
    std::array<prometheus::Counter*, kWiringCauses> wiring = {};
    prometheus::Counter* learning_updates;
    prometheus::Counter* learning_rejected_non_finite;
    prometheus::Counter* learning_rejected_over_budget;
    prometheus::Counter* learning_rejected_held_out;
    std::array<LearningHandles, 2> learning;  // indexed by Scope
  };

  // `name` stands for the policy version in log lines. `config` is that of the policy. The
  // handles and `evidence` must outlive this object. Calls `make` when the first session opens,
  // `robots` for the first request of a robot on a real link, `seats` when the first operator takes
  // control, and `on_end` when it is destroyed.
  PolicyMetrics(std::string name, const LoadedHandles& loaded, VersionEvidence* evidence,
                const ModelConfig& config, PlausibleReturns plausible, UsualObservations usual,
                WiringResponse wiring, std::function<Handles()> make,
                std::function<RobotHandles()> robots, std::function<SeatHandles()> seats,
                std::function<void()> on_end)
      : name_(std::move(name)),
        loaded_(loaded),
        series_(std::move(make)),
        robots_(std::move(robots)),
        seats_(std::move(seats)),
        evidence_(*evidence),
        config_(config),
        plausible_(plausible),
        usual_(std::move(usual)),
        wiring_(wiring),
        on_end_(std::move(on_end)) {
    loaded_.info->Increment();
  }
  ~PolicyMetrics() override {
    loaded_.info->Decrement();
    on_end_();
  }

  void OnOpen() override { series_.get().sessions->Increment(); }
  std::shared_ptr<SessionListener> OnAssigned(absl::string_view tenant) override {
    return evidence_.NewSession(tenant);
  }
  void OnError() override { series_.get().errors->Increment(); }
  void OnClose() override { series_.get().sessions->Decrement(); }
  uint32_t CountUnusual(absl::Span<const float> observation, double return_to_go) override;
  void OnDecision(const Answer& answer) override;
  void OnBeat(const Answer& answer) override;
  void OnSkippedBeats(int64_t beats) override;
  void OnExpired() override { robots_.get().expired->Increment(); }
  void OnRepeated() override { robots_.get().repeated->Increment(); }
  void OnConflict() override { robots_.get().conflicting->Increment(); }
  void OnMissingRewards(int64_t rewards) override {
    robots_.get().missing_rewards->Increment(static_cast<double>(rewards));
  }
  void OnReport(const BeatCounts& beats) override;
  void OnExecuted(SourceKind source) override {
    series_.get().steps[static_cast<size_t>(source)]->Increment();
  }
  void OnSeat(SeatChange change) override {
    seats_.get()[static_cast<size_t>(change)]->Increment();
  }
  void OnImplausible() override { series_.get().implausible->Increment(); }
  void OnNonFinite() override;
  void OnWiring(const std::string& id, WiringCause cause, const std::string& text,
                WiringResponse response) override;
  WiringResponse wiring_response() const override { return wiring_; }
  void OnEpisodeEnd(double episode_return) override;
  void OnHeadUpdate(UpdateOutcome outcome) override;
  void OnLearned(const LearningSummary& summary) override;

 private:
  // Counts what was computed for `answer`.
  void CountWork(const Answer& answer);

  const std::string name_;
  const LoadedHandles loaded_;
  MadeOnce<Handles> series_;
  MadeOnce<RobotHandles> robots_;
  MadeOnce<SeatHandles> seats_;
  VersionEvidence& evidence_;
  const ModelConfig config_;
  const PlausibleReturns plausible_;
  const UsualObservations usual_;
  const WiringResponse wiring_;
  const std::function<void()> on_end_;
  absl::Mutex mutex_;
  int64_t returns_ ABSL_GUARDED_BY(mutex_) = 0;  // that are plausible
  double return_mean_ ABSL_GUARDED_BY(mutex_) = 0.0;
};

}  // namespace spikeserve
