// Robots that play Pendulum-v1 at their own rate against a server. Prints "playing" when all of
// them begin, and at the end one JSON object: beats by source, ages in seconds, returns, and what
// the server lacks. Used by beats_bench.py.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <iostream>
#include <latch>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "absl/time/clock.h"
#include "core/environment/environment.h"
#include "lab/bench/robot_players.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

constexpr absl::Duration kMaxAge = absl::Milliseconds(250);  // PilotOptions::max_age

struct Flags {
  std::string server;
  std::string player = "pilot";
  int robots = 1;
  int connections = 1;  // of all pilots
  double rate = 50.0;   // beats a second
  double seconds = 20.0;
};

// What happened to one robot, or to all of them.
struct Log {
  int64_t beats = 0;
  int64_t by_source[kActionSources] = {};
  int64_t none = 0;   // beats that passed while the robot waited for an action
  int64_t stale = 0;  // fresh actions that were older than kMaxAge when the beat began
  int64_t undefined = 0;
  Comparison server;
  double longest = 0.0;  // seconds without a fresh action
  std::vector<float> ages;
  std::vector<double> returns;

  void Add(const Log& other) {
    beats += other.beats;
    for (size_t i = 0; i < kActionSources; ++i) by_source[i] += other.by_source[i];
    none += other.none;
    stale += other.stale;
    undefined += other.undefined;
    server.Add(other.server);
    longest = std::max(longest, other.longest);
    ages.insert(ages.end(), other.ages.begin(), other.ages.end());
    returns.insert(returns.end(), other.returns.begin(), other.returns.end());
  }
};

class Robot {
 public:
  Robot(std::unique_ptr<RobotPlayer> player, absl::Duration period, uint64_t seed)
      : player_(std::move(player)),
        period_(period),
        environment_(*MakeEnvironment("Pendulum-v1")),
        seed_(seed) {}

  // Plays whole episodes for about `length`.
  void Play(absl::Duration length) {
    const int64_t episode = environment_->max_episode_steps();
    const auto episodes = static_cast<int64_t>(std::ceil(length / period_ / episode));
    due_ = absl::Now();
    fresh_at_ = due_;
    for (int64_t i = 0; i < episodes; ++i) PlayEpisode();
  }

  // Ends the session. Returns what happened.
  Log Finish() {
    log_.server = player_->Finish();
    return std::move(log_);
  }

 private:
  void PlayEpisode() {
    std::vector<float> observation = environment_->Reset(++seed_);
    double reward = 0.0, total = 0.0;
    int64_t beats = 0;
    for (StepResult result; !result.done(); ++beats) {
      result = environment_->Step(Beat(observation, reward));
      observation = result.observation;
      reward = result.reward;
      total += reward;
      // A robot that is late does not hurry to make up for beats.
      due_ = std::max(due_ + period_, absl::Now() - period_);
      absl::SleepFor(due_ - absl::Now());
    }
    const absl::Time ended = absl::Now();
    player_->EndEpisode(reward, beats);
    log_.none += static_cast<int64_t>((absl::Now() - ended) / period_);
    log_.returns.push_back(total);
  }

  Action Beat(absl::Span<const float> observation, double reward) {
    const absl::Time began = absl::Now();
    const Executed executed = player_->Act(observation, reward);
    const absl::Time ended = absl::Now();
    ++log_.beats;
    ++log_.by_source[static_cast<size_t>(executed.source)];
    log_.none += static_cast<int64_t>((ended - began) / period_);
    const bool is_fresh = executed.source == ActionSource::kFresh;
    if (is_fresh && began - (ended - executed.age) > kMaxAge) ++log_.stale;
    log_.longest = std::max(log_.longest, absl::ToDoubleSeconds(ended - fresh_at_));
    if (is_fresh) fresh_at_ = ended;
    if (executed.source != ActionSource::kSafe) {
      log_.ages.push_back(static_cast<float>(absl::ToDoubleSeconds(executed.age)));
    }
    Action action = {.discrete = 0, .continuous = executed.action};
    if (!environment_->action_space().Contains(action).ok()) {
      ++log_.undefined;
      action.continuous = {0.0f};
    }
    return action;
  }

  const std::unique_ptr<RobotPlayer> player_;
  const absl::Duration period_;
  const std::unique_ptr<Environment> environment_;
  uint64_t seed_;
  absl::Time due_;
  absl::Time fresh_at_;
  Log log_;
};

double Quantile(std::vector<float>& sorted, double share) {
  if (sorted.empty()) return 0.0;
  const auto rank = static_cast<size_t>(std::ceil(share * static_cast<double>(sorted.size())));
  return sorted[std::max<size_t>(rank, 1) - 1];
}

nlohmann::json JsonOf(Log log, double seconds) {
  std::sort(log.ages.begin(), log.ages.end());
  double sum = 0.0;
  for (const double value : log.returns) sum += value;
  nlohmann::json json = {{"beats", log.beats},
                         {"seconds", seconds},
                         {"none", log.none},
                         {"stale", log.stale},
                         {"undefined", log.undefined},
                         {"doubled", log.server.doubled},
                         {"missing", log.server.missing},
                         {"longest", log.longest},
                         {"p50", Quantile(log.ages, 0.5)},
                         {"p99", Quantile(log.ages, 0.99)},
                         {"p999", Quantile(log.ages, 0.999)},
                         {"return", sum / static_cast<double>(log.returns.size())}};
  for (size_t i = 0; i < kActionSources; ++i) {
    json[std::string(ActionSourceName(static_cast<ActionSource>(i)))] = log.by_source[i];
  }
  return json;
}

absl::StatusOr<std::vector<std::unique_ptr<Robot>>> MakeRobots(const Flags& flags) {
  const PlayerOptions options = {.servers = flags.server,
                                 .policy = "pendulum-delay",
                                 .period = absl::Seconds(1.0 / flags.rate),
                                 .has_engine = flags.player == "engine",
                                 .transport = flags.player == "datagram" || flags.player == "twice"
                                                  ? PilotTransport::kAuto
                                                  : PilotTransport::kStream,
                                 .redundancy = flags.player == "twice" ? 2 : 1};
  std::vector<std::shared_ptr<Client>> clients;
  std::vector<std::unique_ptr<Robot>> robots;
  for (int i = 0; i < flags.robots; ++i) {
    absl::StatusOr<std::unique_ptr<RobotPlayer>> player;
    if (flags.player == "calls") {
      player = MakeCaller(options);
    } else {
      if (i < flags.connections) {
        auto client = Connect(options);
        if (!client.ok()) return client.status();
        clients.push_back(*std::move(client));
      }
      player = MakePilot(options, clients[static_cast<size_t>(i % flags.connections)]);
    }
    if (!player.ok()) return player.status();
    robots.push_back(std::make_unique<Robot>(*std::move(player), options.period, 1000 * i));
  }
  return robots;
}

absl::Status Run(const Flags& flags) {
  auto robots = MakeRobots(flags);
  if (!robots.ok()) return robots.status();
  std::cout << "playing" << std::endl;
  const absl::Time began = absl::Now();
  std::vector<std::thread> threads;
  for (size_t i = 0; i < robots->size(); ++i) {
    // The beats of the robots are spread evenly over a period.
    const absl::Duration offset = absl::Seconds(static_cast<double>(i) / flags.robots / flags.rate);
    threads.emplace_back([&flags, robot = (*robots)[i].get(), offset] {
      absl::SleepFor(offset);
      robot->Play(absl::Seconds(flags.seconds));
    });
  }
  for (std::thread& thread : threads) thread.join();
  const double seconds = absl::ToDoubleSeconds(absl::Now() - began);
  Log log;
  for (const auto& robot : *robots) log.Add(robot->Finish());
  std::cout << JsonOf(std::move(log), seconds) << std::endl;
  return absl::OkStatus();
}

}  // namespace
}  // namespace spikeserve

int main(int argc, char** argv) {
  spikeserve::Flags flags;
  CLI::App app("Robots that play Pendulum-v1 at their own rate.");
  app.add_option("--server", flags.server)->required();
  app.add_option("--player", flags.player)
      ->check(CLI::IsMember({"calls", "pilot", "engine", "datagram", "twice"}));
  app.add_option("--robots", flags.robots)->check(CLI::Range(1, 1024));
  app.add_option("--connections", flags.connections)->check(CLI::Range(1, 1024));
  app.add_option("--rate", flags.rate)->check(CLI::Range(1.0, 10000.0));
  app.add_option("--seconds", flags.seconds);
  CLI11_PARSE(app, argc, argv);
  const absl::Status status = spikeserve::Run(flags);
  if (!status.ok()) std::cerr << status << std::endl;
  return status.ok() ? 0 : 1;
}
