// Writes the calls of a session on one policy, for the C that `spikectl emit-c` makes of it, and
// prints the hash of the answers of the server's engine to them.
//
// usage: chip_stream POLICY_FILE NAME VERSION SHA256 DECISIONS STREAM
//        chip_stream random NUMBER POLICY_FILE      writes a policy: the bits of NUMBER choose its
//        variants
//
// chip_play.c reads STREAM and describes it. Half of the episodes are played in closed loop where
// the environment is one of ours; the others have observations around and far beyond those of the
// training. In every third episode the session comes from the server, decides on the chip, and goes
// back to the server, several times.
#include <bit>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <iostream>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/agent/agent_session.h"
#include "core/agent/session_request.h"
#include "core/base/clock.h"
#include "core/engine/energy.h"
#include "core/engine/factory/engine_factory.h"
#include "core/environment/environment.h"
#include "core/journal/session_export.h"
#include "core/math/counter_random.h"
#include "core/model/policy_file.h"
#include "core/quantize/quantize_integer.h"
#include "core/session/session_value.h"

namespace spikeserve {
namespace {

constexpr float kLargest = std::numeric_limits<float>::max();
constexpr float kExtremes[] = {1e6f, kLargest, -kLargest, -0.0f, 1e-45f, 1e30f};

template <class T>
T ValueOf(absl::StatusOr<T> value) {
  if (value.ok()) return *std::move(value);
  std::cerr << value.status() << "\n";
  std::exit(1);
}

// FNV-1a of numbers, least significant byte first.
class Hash {
 public:
  void Add(uint64_t value, int bytes) {
    for (int i = 0; i < bytes; ++i) AddByte(static_cast<uint8_t>(value >> (8 * i)));
  }
  void Add(float value) { Add(std::bit_cast<uint32_t>(value), 4); }
  void Add(double value) { Add(std::bit_cast<uint64_t>(value), 8); }
  void AddBytes(const std::string& bytes) {
    for (const char byte : bytes) AddByte(static_cast<uint8_t>(byte));
  }
  uint64_t value() const { return hash_; }

 private:
  void AddByte(uint8_t byte) { hash_ = (hash_ ^ byte) * 0x100000001b3; }

  uint64_t hash_ = 0xcbf29ce484222325;
};

class Stream {
 public:
  Stream(const char* path, std::shared_ptr<const Policy> policy, SessionOptions identity)
      : file_(path, std::ios::binary), policy_(std::move(policy)), identity_(std::move(identity)) {
    served_ = std::make_shared<ServedPolicy>();
    served_->name = identity_.policy;
    served_->version = identity_.version;
    served_->engine = MakeEngine(policy_);
    served_->heads = std::make_shared<TenantHeads>(policy_);
    served_->observer = std::make_shared<SessionObserver>();
    auto environment = MakeEnvironment(policy_->environment);
    if (environment.ok()) environment_ = *std::move(environment);
  }

  // Returns the hash of all answers.
  uint64_t Run(uint64_t decisions) {
    for (uint64_t episode = 0; decisions_ < decisions; ++episode) Episode(episode, decisions);
    file_.put('Q');
    file_.close();
    return hash_.value();
  }

 private:
  template <class T>
  void Put(T value) {
    file_.write(reinterpret_cast<const char*>(&value),
                sizeof(value));  // this machine is little-endian, too
  }
  void Put(const std::vector<float>& values) {
    for (const float value : values) Put(value);
  }
  void PutAction(const std::optional<Action>& action) {
    Put(static_cast<uint8_t>(action.has_value()));
    if (!action.has_value()) return;
    policy_->action_space.is_discrete() ? Put(int32_t{action->discrete}) : Put(action->continuous);
  }

  uint64_t Bits(uint64_t what, uint64_t index = 0) const {
    return RandomBits({what, decisions_, index});
  }

  // Opens a session: on the chip, or on the server with a head of its own, from where it moves.
  void Open(uint64_t episode) {
    SessionRequest request = {.seed = episode};
    if (policy_->action_space.is_discrete() && episode % 4 == 3) {
      request.sample = true;
      request.temperature = 0.75;
    }
    const bool is_moving = episode % 3 == 1;
    if (is_moving) {
      request.head_delta.setZero(
          static_cast<Eigen::Index>(policy_->weights.head.weight.values.size()));
      for (int i = 0; i < request.head_delta.size(); ++i) {
        request.head_delta[i] = 0.02f * UniformFloat(Bits(1, static_cast<uint64_t>(i)));
      }
    }
    SessionOptions options = ValueOf(ResolveSession(std::move(request), *served_));
    options.policy = identity_.policy;
    options.version = identity_.version;
    options.policy_sha256 = identity_.policy_sha256;
    if (is_moving) options.labels = {{"robot", "seven"}, {"site", "north"}};
    agent_.emplace(served_, NewSession("chip", options), &clock_);
    if (is_moving) return Import();
    file_.put('O');
    Put(options.target_return);
    Put(options.seed);
    Put(options.action_selection.sample ? options.action_selection.temperature : 0.0f);
  }

  // The server's session moves to the chip.
  void Import() {
    const std::string value = ExportSession(*agent_);
    file_.put('I');
    Put(static_cast<uint32_t>(value.size()));
    file_ << value;
  }

  // The chip's session moves to the server, which continues from its value.
  void Export() {
    file_.put('X');
    Session session = agent_->session();
    session.wiring = {};  // a chip does not test the wiring
    agent_.emplace(served_, std::move(session), &clock_);
    const std::string value = ExportSession(*agent_);
    hash_.AddBytes(value);
    agent_.emplace(served_, ValueOf(ImportSession(value)), &clock_);
  }

  std::vector<float> Observation(bool is_far) const {
    std::vector<float> observation;
    const Weights& weights = policy_->weights;
    for (int i = 0; i < policy_->observation_size(); ++i) {
      const uint64_t bits = Bits(2, static_cast<uint64_t>(i));
      const float spread = decisions_ % 5 == 0 ? 6.0f : 2.0f;
      observation.push_back(weights.observation_mean.values[i] +
                            spread * (UniformFloat(bits) - 0.5f) *
                                weights.observation_std.values[i]);
      if (is_far && bits % 7 == 0) observation.back() = kExtremes[bits / 7 % std::size(kExtremes)];
    }
    return observation;
  }

  // Calls that must fail and change nothing.
  void Refused(const std::vector<float>& observation) {
    if (Bits(3) % 16 != 0) return;
    std::vector<float> wrong = observation;
    wrong[Bits(4) % wrong.size()] =
        Bits(5) % 2 == 0 ? std::nanf("") : -std::numeric_limits<float>::infinity();
    file_.put('N');
    Put(wrong);
    Put(0.0);
  }

  std::optional<Action> Executed() const {
    if (agent_->session().step == 0 || Bits(6) % 8 != 0) return std::nullopt;
    const ActionSpace& space = policy_->action_space;
    Action action;
    if (space.is_discrete()) {
      action.discrete = static_cast<int>(Bits(7) % static_cast<uint64_t>(space.n));
    } else {
      for (size_t i = 0; i < space.low.size(); ++i) {
        action.continuous.push_back(space.FromUnit(2.0f * UniformFloat(Bits(7, i)) - 1.0f, i));
      }
    }
    return action;
  }

  // Decides on both sides, and returns the action.
  Action Decide(const std::vector<float>& observation, double reward, bool may_differ) {
    Refused(observation);
    const std::optional<Action> executed = may_differ ? Executed() : std::nullopt;
    file_.put('D');
    Put(observation);
    Put(reward);
    PutAction(executed);
    std::optional<ReportedAction> reported;
    if (executed.has_value()) {
      reported = policy_->action_space.is_discrete()
                     ? ReportedAction(int64_t{executed->discrete})
                     : ReportedAction(absl::MakeConstSpan(executed->continuous));
    }
    const Answer& answer =
        *ValueOf(agent_->Act(agent_->session().step, observation, reward, reported));
    agent_->AppendPendingAction();
    ++decisions_;
    AddAnswer(answer);
    return answer.action;
  }

  void AddAnswer(const Answer& answer) {
    if (policy_->action_space.is_discrete())
      hash_.Add(static_cast<uint64_t>(answer.action.discrete), 4);
    for (const float value : answer.action.continuous) hash_.Add(value);
    hash_.Add(answer.return_to_go);
    for (const float logit : answer.logits) hash_.Add(logit);
    for (const float probability : answer.probabilities) hash_.Add(probability);
    const Counts& c = answer.counts;
    for (const uint64_t spikes : c.spikes_by_stage) hash_.Add(spikes, 4);
    for (const uint64_t count :
         {c.accumulates, c.multiply_accumulates, c.attention_products,
          c.integer_multiply_accumulates, c.membrane_updates, c.coder_gains, c.layer_norm_elements,
          c.softmax_terms, c.gate_products, c.driven_neurons, c.membrane_leaks,
          c.wide_multiply_accumulates, c.attention_scalings, c.weight_bytes, c.attention_bytes}) {
      hash_.Add(count, 4);
    }
    hash_.Add(*EstimateEnergy(EnergyModel::kInt45nm, c, policy_->config));
    hash_.Add(*EstimateEnergy(EnergyModel::kIntSram45nm, c, policy_->config));
  }

  void Episode(uint64_t episode, uint64_t decisions) {
    if (episode % 3 != 2) Open(episode);  // otherwise the session goes on
    const bool is_closed_loop = environment_ != nullptr && episode % 2 == 0;
    const bool is_far = episode % 4 == 1;
    const uint64_t steps = is_closed_loop ? 1000 : 20 + Bits(8) % 100;
    std::vector<float> observation =
        is_closed_loop ? environment_->Reset(episode) : Observation(is_far);
    double reward = 0.0;
    bool is_terminated = false;
    for (uint64_t step = 0; step < steps && decisions_ < decisions; ++step) {
      if (episode % 3 == 1 && Bits(9) % 4 == 0) Move(observation, reward);
      const Action action = Decide(observation, reward, !is_closed_loop);
      if (is_closed_loop) {
        StepResult result = environment_->Step(action);
        observation = std::move(result.observation);
        reward = result.reward;
        is_terminated = result.terminated;
        if (result.done()) break;
      } else {
        observation = Observation(is_far);
        reward = static_cast<double>(policy_->return_scale) * (UniformDouble(Bits(10)) - 0.5);
      }
    }
    End(reward, is_terminated, episode);
  }

  // To the server and back. The server alone decides a step in between.
  void Move(const std::vector<float>& observation, double reward) {
    Export();
    if (agent_->session().step > 0)
      ValueOf(agent_->Act(agent_->session().step, observation, reward));
    Import();
  }

  void End(double reward, bool terminated, uint64_t episode) {
    EpisodeEnd end = {.reward = reward, .terminated = terminated};
    if (episode % 5 == 4) end.target_return = 0.5 * static_cast<double>(policy_->target_return);
    file_.put('E');
    Put(reward);
    Put(static_cast<uint8_t>(terminated));
    Put(static_cast<uint8_t>(end.target_return.has_value()));
    if (end.target_return.has_value()) Put(*end.target_return);
    ValueOf(agent_->EndEpisode(end));
    Export();
    Import();
  }

  std::ofstream file_;
  std::shared_ptr<const Policy> policy_;
  const SessionOptions identity_;  // of the policy
  std::shared_ptr<ServedPolicy> served_;
  std::unique_ptr<Environment> environment_;  // null: none of ours
  SteadyClock clock_;
  std::optional<AgentSession> agent_;
  Hash hash_;
  uint64_t decisions_ = 0;
};

// Writes a policy of random weights and of sizes that no shipped one has.
void WriteRandom(unsigned number, const char* path) {
  const auto bit = [number](int i) { return (number >> i & 1) != 0; };
  ModelConfig config = {.mode = bit(0) ? Mode::kFull : Mode::kRoute,
                        .hidden_size = bit(1) ? 36 : 80,
                        .heads = bit(1) ? 3 : 2,
                        .layers = bit(2) ? 3 : 2,
                        .ticks = bit(2) ? 7 : 12,
                        .context = 4,
                        .routing_hidden_size = 5,
                        .ffn_size = 50};
  config.phase_clock = bit(3) ? PhaseClock::kWindow : PhaseClock::kTimestep;
  config.merge = bit(4) ? Merge::kConcat : Merge::kSum;
  config.gate = bit(5) ? Gate::kSigmoid : Gate::kSoftmax;
  config.observation_changes = bit(6);
  const ActionSpace space =
      bit(3) ? ActionSpace::Discrete(3) : ActionSpace::Box({-1.0f, -3e38f}, {0.5f, 3e38f});
  const Policy policy = ValueOf(QuantizeToInteger(RandomPolicy(config, 3, space, number)));
  const absl::Status written = WritePolicyFile(policy, path);
  if (written.ok()) return;
  std::cerr << written << "\n";
  std::exit(1);
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  if (argc == 4 && std::string(argv[1]) == "random") {
    spikeserve::WriteRandom(static_cast<unsigned>(std::stoul(argv[2])), argv[3]);
    return 0;
  }
  if (argc != 7) {
    std::cerr << "usage: chip_stream POLICY_FILE NAME VERSION SHA256 DECISIONS STREAM | random "
                 "NUMBER FILE\n";
    return 1;
  }
  const auto policy = std::make_shared<const spikeserve::Policy>(
      spikeserve::ValueOf(spikeserve::ReadPolicyFile(argv[1])));
  spikeserve::SessionOptions identity;
  identity.policy = argv[2];
  identity.version = std::stoll(argv[3]);
  identity.policy_sha256 = argv[4];
  spikeserve::Stream stream(argv[6], policy, identity);
  std::cout << std::hex << stream.Run(std::stoull(argv[5])) << "\n";
}
