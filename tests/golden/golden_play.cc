#include "tests/golden/golden_play.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <limits>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "core/agent/agent_session.h"
#include "core/agent/session_request.h"
#include "core/engine/factory/engine_factory.h"
#include "core/learning/return_guard.h"
#include "core/math/counter_random.h"
#include "core/model/policy_file.h"
#include "core/session/session_value.h"
#include "tests/support/fake_clock.h"

namespace spikeserve::golden {
namespace {

constexpr float kLargest = std::numeric_limits<float>::max();
constexpr float kSmallest = std::numeric_limits<float>::denorm_min();
constexpr float kNan = std::numeric_limits<float>::quiet_NaN();

void Require(const absl::Status& status) {
  if (status.ok()) return;
  std::cerr << status << '\n';
  std::abort();
}

// Returns a number in [-1, 1).
float Draw(uint64_t what, uint64_t step, uint64_t index) {
  return 2.0f * UniformFloat(RandomBits({what, step, index})) - 1.0f;
}

// The bytes of answers.
class Transcript {
 public:
  void Add(uint64_t value) {
    for (int i = 0; i < 8; ++i) bytes_.push_back(static_cast<char>(value >> (8 * i)));
  }
  // Processors differ in the sign of the NaN that an operation makes, which is no number.
  void Add(double value) { Add(std::isnan(value) ? ~uint64_t{0} : std::bit_cast<uint64_t>(value)); }
  template <class Values>
  void AddAll(const Values& values) {
    Add(static_cast<uint64_t>(values.size()));
    for (const auto& value : values) Add(Widened(value));
  }

  void Add(const Answer& answer) {
    Add(static_cast<uint64_t>(answer.step));
    Add(static_cast<uint64_t>(answer.action.discrete));
    AddAll(answer.action.continuous);
    AddAll(answer.probabilities);
    AddAll(answer.logits);
    Add(static_cast<double>(answer.return_to_go));
    const Counts& counts = answer.counts;
    AddAll(counts.spikes_by_stage);
    AddAll(std::array{counts.accumulates, counts.multiply_accumulates, counts.attention_products,
                      counts.integer_multiply_accumulates, counts.membrane_updates,
                      counts.coder_gains, counts.layer_norm_elements, counts.softmax_terms,
                      counts.gate_products});
  }

  const std::string& bytes() const { return bytes_; }

 private:
  static double Widened(float value) { return static_cast<double>(value); }
  static uint64_t Widened(uint64_t value) { return value; }

  std::string bytes_;
};

// A session on one policy, whose requests and answers go into a transcript.
class Play {
 public:
  Play(const Policy& policy, Kind kind) : policy_(std::make_shared<const Policy>(policy)) {
    auto served = std::make_shared<ServedPolicy>();
    served->name = "golden";
    served->version = 1;
    served->engine = MakeEngine(policy_);
    served->heads = std::make_shared<TenantHeads>(policy_);
    served->observer = std::make_shared<SessionObserver>();
    SessionRequest request = {.seed = 7, .sample = kind != Kind::kGreedy};
    if (request.sample) request.temperature = 0.75;
    if (kind == Kind::kLearning) request.learning = LearningRequest();
    absl::StatusOr<SessionOptions> options = ResolveSession(std::move(request), *served);
    Require(options.status());
    agent_.emplace(served, NewSession("golden", *std::move(options)), &clock_);
  }

  // Plays an episode of `steps` decisions. `extreme`: some of its numbers are the largest, the
  // smallest, or refused.
  void Episode(int steps, bool extreme) {
    for (int step = 0; step < steps; ++step, ++time_) {
      if (extreme && step % 5 == 3) ActRefused();
      Act(Observation(extreme), Reward(extreme));
    }
    const auto summary =
        agent_->EndEpisode({.reward = Reward(false), .terminated = steps % 2 == 0});
    Require(summary.status());
    transcript_.Add(summary->episode_return);
    transcript_.Add(summary->spikes);
    if (!summary->learning.has_value()) return;
    transcript_.Add(static_cast<uint64_t>(summary->learning->updates));
    transcript_.Add(summary->learning->head_drift);
    transcript_.Add(summary->learning->returns.mean);
    transcript_.Add(summary->learning->watched_return);
    transcript_.Add(static_cast<uint64_t>(summary->learning->rolled_back));
  }

  std::string Finish() {
    const Eigen::VectorXf delta = agent_->HeadDelta();
    transcript_.AddAll(std::vector<float>(delta.begin(), delta.end()));
    return transcript_.bytes();
  }

 private:
  void Act(const std::vector<float>& observation, double reward) {
    const auto answer = agent_->Act(agent_->session().step, observation, reward);
    transcript_.Add(static_cast<uint64_t>(answer.status().code()));
    if (answer.ok()) transcript_.Add(**answer);
  }

  // Sends requests that every session refuses.
  void ActRefused() {
    std::vector<float> observation = Observation(false);
    observation.push_back(0.0f);
    Act(observation, 0.0);
    observation.pop_back();
    Act(observation, static_cast<double>(kNan));
    observation.back() = kNan;
    Act(observation, 0.0);
    observation.back() = -std::numeric_limits<float>::infinity();
    Act(observation, 0.0);
  }

  // Returns an observation within a few deviations of the training data's mean, or far beyond.
  std::vector<float> Observation(bool extreme) const {
    constexpr float kSpreads[] = {1.0f, 0.25f, 3.0f, 1.0f, 30.0f, 0.0f, 2.0f};
    constexpr float kExtremes[] = {1e6f, kLargest, -kLargest, -0.0f, kSmallest, 1e30f};
    std::vector<float> observation(static_cast<size_t>(policy_->observation_size()));
    for (size_t i = 0; i < observation.size(); ++i) {
      const float deviations = kSpreads[time_ % std::size(kSpreads)] * Draw(1, time_, i);
      observation[i] = policy_->weights.observation_mean.values[i] +
                       deviations * policy_->weights.observation_std.values[i];
      if (extreme && RandomBits({3, time_, i}) % 3 == 0) {
        observation[i] = kExtremes[(time_ + i) % std::size(kExtremes)];
      }
    }
    return observation;
  }

  double Reward(bool extreme) const {
    constexpr double kExtremes[] = {0.0, 1e6, -1e6, 1e30, -1e30};
    if (extreme && time_ % 4 == 0) return kExtremes[time_ / 4 % std::size(kExtremes)];
    return static_cast<double>(policy_->return_scale * 0.1f * Draw(2, time_, 0));
  }

  FakeClock clock_;
  std::shared_ptr<const Policy> policy_;
  std::optional<AgentSession> agent_;
  Transcript transcript_;
  uint64_t time_ = 0;  // of the next decision; the key of its random numbers
};

}  // namespace

std::vector<Subject> RandomSubjects() {
  ModelConfig config = {
      .hidden_size = 32, .heads = 4, .layers = 2, .ticks = 5, .context = 6, .ffn_size = 64};
  std::vector<Subject> subjects;
  const auto add = [&](const std::string& name) {
    subjects.push_back({name, RandomPolicy(config, 4, ActionSpace::Discrete(3), /*seed=*/1)});
  };
  for (const auto& [mode, name] : EnumNames(Mode())) {
    config.mode = mode;
    add("random-" + std::string(name));
  }
  config.mode = Mode::kFull;
  config.merge = Merge::kConcat;
  config.observation_changes = true;
  add("random-concat");
  return subjects;
}

Policy ReadPolicy(const std::string& path) {
  absl::StatusOr<Policy> policy = ReadPolicyFile(path);
  Require(policy.status());
  return *std::move(policy);
}

std::string PlayGolden(const Policy& policy, Kind kind) {
  Play play(policy, kind);
  if (kind == Kind::kLearning) {
    // Long enough for the guard to compare two windows of episodes.
    for (size_t i = 0; i < 2 * ReturnGuard::kWindow + 1; ++i) play.Episode(2, /*extreme=*/false);
    return play.Finish();
  }
  const bool is_greedy = kind == Kind::kGreedy;
  play.Episode(is_greedy ? 30 : 12, /*extreme=*/false);  // longer than the window of most policies
  play.Episode(is_greedy ? 24 : 12, /*extreme=*/true);
  return play.Finish();
}

}  // namespace spikeserve::golden
